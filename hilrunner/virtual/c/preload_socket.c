/* CAN sockets: opened, bound, filtered, asked about. */
#include "preload.h"

can_t *can_at(int fd) { return fd >= 0 && fd < FD_MAX ? can_of[fd] : NULL; }

static int open_can(int type, int protocol)
{
    claim();
    if ((type & 0xff) != SOCK_RAW || protocol != CAN_RAW) {
        static const char *const names[] = {"0", "CAN_RAW", "CAN_BCM", "TP16", "TP20", "MCNET", "ISOTP", "J1939"};
        fprintf(stderr, "hilrunner: virtual time has raw CAN sockets only; %s is told to be unknown to this kernel\n",
                protocol >= 0 && protocol < 8 ? names[protocol] : "that protocol");
        errno = EPROTONOSUPPORT;
        return -1;
    }
    int fd = eventfd(0, EFD_SEMAPHORE | ((type & SOCK_NONBLOCK) ? EFD_NONBLOCK : 0) | ((type & SOCK_CLOEXEC) ? EFD_CLOEXEC : 0));
    if (fd < 0 || fd >= FD_MAX) {
        return fd < 0 ? fd : (get_close()(fd), errno = EMFILE, -1);
    }
    can_t *can = calloc(1, sizeof *can);
    can->queue = calloc(QUEUE_SIZE, sizeof *can->queue);
    can->bus = -1;
    can->references = 1;
    can->loopback = true;
    can->event_fd = fd;
    can->filter_count = 1; /* as the kernel has it: everything */
    can_of[fd] = can;
    return fd;
}

int socket(int domain, int type, int protocol)
{
    if (region != NULL && domain == PF_CAN) {
        return open_can(type, protocol);
    }
    return get_socket()(domain, type, protocol);
}

int bus_of_index(int index)
{
    return index == 0 ? -2 : index >= FIRST_INDEX && index < FIRST_INDEX + region->bus_count ? index - FIRST_INDEX : -1;
}

int bind(int fd, const struct sockaddr *address, socklen_t size)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_bind()(fd, address, size);
    }
    const struct sockaddr_can *wanted = (const void *)address;
    int bus = bus_of_index(wanted->can_ifindex);
    if (bus == -1) {
        errno = ENODEV;
        return -1;
    }
    can->bus = bus;
    return 0;
}

int connect(int fd, const struct sockaddr *address, socklen_t size)
{
    if (can_at(fd) == NULL) {
        return get_connect()(fd, address, size);
    }
    errno = EOPNOTSUPP;
    return -1;
}

int getsockname(int fd, struct sockaddr *restrict address, socklen_t *restrict size)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_getsockname()(fd, address, size);
    }
    struct sockaddr_can own = {.can_family = AF_CAN, .can_ifindex = can->bus >= 0 ? can->bus + FIRST_INDEX : 0};
    memcpy(address, &own, *size < sizeof own ? *size : sizeof own);
    *size = sizeof own;
    return 0;
}

static int flag_option(bool *flag, const void *value, socklen_t size)
{
    int number;
    if (size != sizeof number) {
        errno = EINVAL;
        return -1;
    }
    memcpy(&number, value, sizeof number);
    *flag = number != 0;
    return 0;
}

static int set_raw_option(can_t *can, int name, const void *value, socklen_t size)
{
    switch (name) {
    case CAN_RAW_FILTER:
        if (size > sizeof can->filter || size % sizeof can->filter[0] != 0) {
            errno = EINVAL;
            return -1;
        }
        memcpy(can->filter, value, size);
        can->filter_count = (int)(size / sizeof can->filter[0]);
        return 0;
    case CAN_RAW_RECV_OWN_MSGS:
        return flag_option(&can->own, value, size);
    case CAN_RAW_LOOPBACK:
        return flag_option(&can->loopback, value, size);
    case CAN_RAW_FD_FRAMES:
        return flag_option(&can->fd_frames, value, size);
    case CAN_RAW_JOIN_FILTERS:
        return flag_option(&can->join_filters, value, size);
    case CAN_RAW_ERR_FILTER:
        return 0; /* an ideal bus has no error frames */
    default:
        errno = ENOPROTOOPT;
        return -1;
    }
}

int setsockopt(int fd, int level, int name, const void *value, socklen_t size)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_setsockopt()(fd, level, name, value, size);
    }
    if (level == SOL_CAN_RAW) {
        return set_raw_option(can, name, value, size);
    }
    if (level == SOL_SOCKET && name == SO_TIMESTAMP) {
        return flag_option(&can->timestamp, value, size);
    }
    if (level == SOL_SOCKET && name == SO_TIMESTAMPNS) {
        return flag_option(&can->timestamp_ns, value, size);
    }
    if (level == SOL_SOCKET && name == SO_RCVTIMEO && size == sizeof(struct timeval)) {
        struct timeval limit;
        memcpy(&limit, value, sizeof limit);
        can->receive_timeout_ns = (int64_t)limit.tv_sec * NS_PER_S + (int64_t)limit.tv_usec * 1000;
    }
    return 0; /* buffer sizes, priorities, time-outs of sending: nothing here depends on them */
}

int getsockopt(int fd, int level, int name, void *restrict value, socklen_t *restrict size)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_getsockopt()(fd, level, name, value, size);
    }
    int number = 0;
    if (level == SOL_SOCKET) {
        number = name == SO_TYPE ? SOCK_RAW : name == SO_DOMAIN ? PF_CAN : name == SO_PROTOCOL ? CAN_RAW : name == SO_RCVBUF ? QUEUE_SIZE * 256 : 0;
    } else if (level == SOL_CAN_RAW) {
        number = name == CAN_RAW_RECV_OWN_MSGS ? can->own : name == CAN_RAW_LOOPBACK ? can->loopback : name == CAN_RAW_FD_FRAMES ? can->fd_frames : 0;
    }
    memcpy(value, &number, *size < sizeof number ? *size : sizeof number);
    *size = sizeof number;
    return 0;
}

unsigned if_nametoindex(const char *name)
{
    if (region == NULL) {
        return get_if_nametoindex()(name);
    }
    for (int bus = 0; bus < region->bus_count; bus++) {
        if (strncmp(region->bus[bus].name, name, VB_NAME_SIZE) == 0) {
            return (unsigned)(bus + FIRST_INDEX);
        }
    }
    errno = ENODEV;
    return 0;
}

char *if_indextoname(unsigned index, char name[IF_NAMESIZE])
{
    if (region == NULL) {
        return get_if_indextoname()(index, name);
    }
    int bus = bus_of_index((int)index);
    if (bus < 0) {
        errno = ENXIO;
        return NULL;
    }
    return strcpy(name, region->bus[bus].name);
}

static int interface_request(unsigned long request, struct ifreq *wanted)
{
    int bus = -1;
    if (request == SIOCGIFNAME) {
        bus = bus_of_index(wanted->ifr_ifindex);
        if (bus >= 0) {
            strcpy(wanted->ifr_name, region->bus[bus].name);
            return 0;
        }
    } else {
        unsigned index = if_nametoindex(wanted->ifr_name);
        bus = index == 0 ? -1 : (int)index - FIRST_INDEX;
    }
    if (bus < 0) {
        errno = ENODEV;
        return -1;
    }
    if (request == SIOCGIFINDEX) {
        wanted->ifr_ifindex = bus + FIRST_INDEX;
    } else if (request == SIOCGIFMTU) {
        wanted->ifr_mtu = region->bus[bus].fd ? CANFD_MTU : CAN_MTU;
    } else {
        wanted->ifr_flags = IFF_UP | IFF_RUNNING | IFF_NOARP;
    }
    return 0;
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list words;
    va_start(words, request);
    void *argument = va_arg(words, void *);
    va_end(words);
    if (can_at(fd) != NULL) {
        if (request == SIOCGIFINDEX || request == SIOCGIFNAME || request == SIOCGIFMTU || request == SIOCGIFFLAGS) {
            return interface_request(request, argument);
        }
        if (request == SIOCGSTAMP || request == SIOCGSTAMPNS) {
            errno = ENOENT; /* use SO_TIMESTAMP */
            return -1;
        }
    }
    return get_ioctl()(fd, request, argument);
}
