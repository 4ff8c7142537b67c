/* Frames of CAN sockets: received and sent by every call there is for it. */
#include "preload.h"

bool is_nonblocking(int fd, int flags)
{
    return (flags & MSG_DONTWAIT) || (get_fcntl()(fd, F_GETFL, 0) & O_NONBLOCK);
}

static bool has_frame(const can_t *can) { return can->read < can->written; }

/* The oldest frame, waited for if the socket blocks; NULL with errno. */
static const vb_frame_t *next_frame(int fd, can_t *can, int flags)
{
    claim();
    if (can->bus == -1) {
        errno = ENETDOWN; /* never bound */
        return NULL;
    }
    if (has_frame(can)) {
        return &can->queue[can->read % QUEUE_SIZE];
    }
    if (is_nonblocking(fd, flags)) {
        spend();
        if (!has_frame(can)) {
            errno = EAGAIN;
            return NULL;
        }
    }
    int64_t until = can->receive_timeout_ns > 0 ? now_ns() + can->receive_timeout_ns : VB_NEVER;
    while (!has_frame(can)) {
        if (now_ns() >= until) {
            errno = EAGAIN;
            return NULL;
        }
        if (!sleep_turn(until, true)) {
            return NULL;
        }
    }
    return &can->queue[can->read % QUEUE_SIZE];
}

static void drop_oldest(can_t *can)
{
    can->read++;
    if (!has_frame(can)) {
        uint64_t one;
        int mode = get_fcntl()(can->event_fd, F_GETFL, 0);
        get_fcntl()(can->event_fd, F_SETFL, (void *)(long)(mode | O_NONBLOCK));
        (void)!get_read()(can->event_fd, &one, sizeof one);
        get_fcntl()(can->event_fd, F_SETFL, (void *)(long)mode);
    }
}

static void fill_address(const vb_frame_t *frame, void *address, socklen_t *size)
{
    if (address == NULL || size == NULL) {
        return;
    }
    struct sockaddr_can from = {.can_family = AF_CAN, .can_ifindex = frame->bus + FIRST_INDEX};
    memcpy(address, &from, *size < sizeof from ? *size : sizeof from);
    *size = sizeof from;
}

static ssize_t receive_one(int fd, can_t *can, void *data, size_t size, int flags, void *address, socklen_t *address_size)
{
    const vb_frame_t *frame = next_frame(fd, can, flags);
    if (frame == NULL) {
        return -1;
    }
    size_t count = (size_t)frame->size < size ? (size_t)frame->size : size;
    memcpy(data, frame->frame, count);
    fill_address(frame, address, address_size);
    ssize_t result = (flags & MSG_TRUNC) ? frame->size : (ssize_t)count;
    if (!(flags & MSG_PEEK)) {
        drop_oldest(can);
    }
    return result;
}

static void add_control(struct msghdr *message, size_t *used, int type, const void *data, size_t size)
{
    if (message->msg_control == NULL || *used + CMSG_SPACE(size) > message->msg_controllen) {
        message->msg_flags |= MSG_CTRUNC;
        return;
    }
    struct cmsghdr *head = (struct cmsghdr *)((char *)message->msg_control + *used);
    head->cmsg_len = CMSG_LEN(size);
    head->cmsg_level = SOL_SOCKET;
    head->cmsg_type = type;
    memcpy(CMSG_DATA(head), data, size);
    *used += CMSG_SPACE(size);
}

static ssize_t receive_message(int fd, can_t *can, struct msghdr *message, int flags)
{
    const vb_frame_t *frame = next_frame(fd, can, flags);
    if (frame == NULL) {
        return -1;
    }
    size_t count = 0;
    for (size_t k = 0; k < message->msg_iovlen && count < (size_t)frame->size; k++) {
        size_t part = (size_t)frame->size - count;
        part = part < message->msg_iov[k].iov_len ? part : message->msg_iov[k].iov_len;
        memcpy(message->msg_iov[k].iov_base, frame->frame + count, part);
        count += part;
    }
    if (message->msg_name != NULL) {
        fill_address(frame, message->msg_name, &message->msg_namelen);
    }
    message->msg_flags = (frame->own ? MSG_CONFIRM | MSG_DONTROUTE : 0) | (count < (size_t)frame->size ? MSG_TRUNC : 0);
    size_t used = 0;
    int64_t real_ns = frame->stamp_mono_ns + region->real_minus_mono_ns;
    if (can->timestamp_ns) {
        struct timespec stamp;
        set_timespec(&stamp, real_ns);
        add_control(message, &used, SCM_TIMESTAMPNS, &stamp, sizeof stamp);
    } else if (can->timestamp) {
        struct timeval stamp = {.tv_sec = (time_t)(real_ns / NS_PER_S), .tv_usec = (suseconds_t)(real_ns % NS_PER_S / 1000)};
        add_control(message, &used, SCM_TIMESTAMP, &stamp, sizeof stamp);
    }
    message->msg_controllen = used;
    if (!(flags & MSG_PEEK)) {
        drop_oldest(can);
    }
    return (ssize_t)count;
}

static ssize_t send_frame(can_t *can, const void *data, size_t size)
{
    claim();
    if ((size != CAN_MTU && size != CANFD_MTU) || (size == CANFD_MTU && !can->fd_frames)) {
        errno = EINVAL;
        return -1;
    }
    if (can->bus < 0) {
        errno = ENXIO;
        return -1;
    }
    if (size == CANFD_MTU && !region->bus[can->bus].fd) {
        errno = EINVAL;
        return -1;
    }
    if (node->send_written - node->send_read >= VB_SEND_SIZE) {
        node->send_refused++;
        spend();
        errno = ENOBUFS;
        return -1;
    }
    vb_frame_t *slot = &node->send[node->send_written % VB_SEND_SIZE];
    memset(slot, 0, sizeof *slot);
    slot->stamp_mono_ns = now_ns();
    slot->bus = can->bus;
    slot->size = (int32_t)size;
    memcpy(slot->frame, data, size);
    node->send_written++;
    for (int fd = 0; can->loopback && fd < FD_MAX; fd++) { /* other sockets of this process hear it at once, as the kernel loops it back */
        if (can_of[fd] != NULL && can_of[fd] != can && !can_of[fd]->own && !seen_before(fd)) {
            enqueue(can_of[fd], slot);
        }
    }
    return (ssize_t)size;
}

static ssize_t send_pieces(can_t *can, const struct iovec *pieces, size_t count)
{
    uint8_t frame[CANFD_MTU + 1];
    size_t size = 0;
    for (size_t k = 0; k < count; k++) {
        if (size + pieces[k].iov_len > CANFD_MTU) {
            errno = EINVAL;
            return -1;
        }
        memcpy(frame + size, pieces[k].iov_base, pieces[k].iov_len);
        size += pieces[k].iov_len;
    }
    return send_frame(can, frame, size);
}

ssize_t read(int fd, void *data, size_t size)
{
    can_t *can = can_at(fd);
    timer_t_ *timer = timer_at(fd);
    if (can != NULL) {
        return receive_one(fd, can, data, size, 0, NULL, NULL);
    }
    if (timer != NULL && !is_nonblocking(fd, 0)) {
        struct pollfd look = {.fd = fd, .events = POLLIN};
        while (get_poll()(&look, 1, 0) == 0) {
            if (!sleep_turn(VB_NEVER, false)) {
                return -1;
            }
        }
    }
    return get_read()(fd, data, size);
}

ssize_t __read_chk(int fd, void *data, size_t size, size_t room);
ssize_t __read_chk(int fd, void *data, size_t size, size_t room)
{
    return size > room ? (abort(), -1) : read(fd, data, size);
}

ssize_t write(int fd, const void *data, size_t size)
{
    can_t *can = can_at(fd);
    return can != NULL ? send_frame(can, data, size) : get_write()(fd, data, size);
}

ssize_t readv(int fd, const struct iovec *pieces, int count)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_readv()(fd, pieces, count);
    }
    struct msghdr message = {.msg_iov = (struct iovec *)pieces, .msg_iovlen = (size_t)count};
    return receive_message(fd, can, &message, 0);
}

ssize_t writev(int fd, const struct iovec *pieces, int count)
{
    can_t *can = can_at(fd);
    return can != NULL ? send_pieces(can, pieces, (size_t)count) : get_writev()(fd, pieces, count);
}

ssize_t recv(int fd, void *data, size_t size, int flags)
{
    can_t *can = can_at(fd);
    return can != NULL ? receive_one(fd, can, data, size, flags, NULL, NULL) : get_recv()(fd, data, size, flags);
}

ssize_t __recv_chk(int fd, void *data, size_t size, size_t room, int flags);
ssize_t __recv_chk(int fd, void *data, size_t size, size_t room, int flags)
{
    return size > room ? (abort(), -1) : recv(fd, data, size, flags);
}

ssize_t recvfrom(int fd, void *restrict data, size_t size, int flags, struct sockaddr *restrict address, socklen_t *restrict address_size)
{
    can_t *can = can_at(fd);
    return can != NULL ? receive_one(fd, can, data, size, flags, address, address_size)
                       : get_recvfrom()(fd, data, size, flags, address, address_size);
}

ssize_t __recvfrom_chk(int fd, void *restrict data, size_t size, size_t room, int flags, struct sockaddr *restrict address,
                       socklen_t *restrict address_size);
ssize_t __recvfrom_chk(int fd, void *restrict data, size_t size, size_t room, int flags, struct sockaddr *restrict address,
                       socklen_t *restrict address_size)
{
    return size > room ? (abort(), -1) : recvfrom(fd, data, size, flags, address, address_size);
}

ssize_t recvmsg(int fd, struct msghdr *message, int flags)
{
    can_t *can = can_at(fd);
    return can != NULL ? receive_message(fd, can, message, flags) : get_recvmsg()(fd, message, flags);
}

int recvmmsg(int fd, struct mmsghdr *messages, unsigned count, int flags, struct timespec *limit)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_recvmmsg()(fd, messages, count, flags, limit);
    }
    unsigned got = 0;
    while (got < count) {
        ssize_t size = receive_message(fd, can, &messages[got].msg_hdr, got > 0 && (flags & MSG_WAITFORONE) ? flags | MSG_DONTWAIT : flags);
        if (size < 0) {
            return got > 0 ? (int)got : -1;
        }
        messages[got].msg_len = (unsigned)size;
        got++;
    }
    return (int)got;
}

ssize_t send(int fd, const void *data, size_t size, int flags)
{
    can_t *can = can_at(fd);
    return can != NULL ? send_frame(can, data, size) : get_send()(fd, data, size, flags);
}

ssize_t sendto(int fd, const void *data, size_t size, int flags, const struct sockaddr *address, socklen_t address_size)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_sendto()(fd, data, size, flags, address, address_size);
    }
    if (address != NULL && can->bus == -2) { /* bound to all: the address names the interface */
        int bus = bus_of_index(((const struct sockaddr_can *)(const void *)address)->can_ifindex);
        can->bus = bus;
        ssize_t sent = send_frame(can, data, size);
        can->bus = -2;
        return sent;
    }
    return send_frame(can, data, size);
}

ssize_t sendmsg(int fd, const struct msghdr *message, int flags)
{
    can_t *can = can_at(fd);
    return can != NULL ? send_pieces(can, message->msg_iov, message->msg_iovlen) : get_sendmsg()(fd, message, flags);
}

int sendmmsg(int fd, struct mmsghdr *messages, unsigned count, int flags)
{
    can_t *can = can_at(fd);
    if (can == NULL) {
        return get_sendmmsg()(fd, messages, count, flags);
    }
    for (unsigned k = 0; k < count; k++) {
        ssize_t size = send_pieces(can, messages[k].msg_hdr.msg_iov, messages[k].msg_hdr.msg_iovlen);
        if (size < 0) {
            return k > 0 ? (int)k : -1;
        }
        messages[k].msg_len = (unsigned)size;
    }
    return (int)count;
}
