/* Descriptors under further names, and waiting for several of them. */
#include "preload.h"

static void forget(int fd)
{
    can_t *can = can_at(fd);
    timer_t_ *timer = timer_at(fd);
    if (can != NULL) {
        can_of[fd] = NULL;
        if (--can->references == 0) {
            free(can->queue);
            free(can);
        }
    }
    if (timer != NULL) {
        timer_of[fd] = NULL;
        if (--timer->references == 0) {
            free(timer);
        }
    }
}

static int share(int from, int to)
{
    if (to >= 0 && to < FD_MAX && from >= 0 && from < FD_MAX && to != from) {
        if (can_of[from] != NULL) {
            can_of[from]->references++;
            can_of[to] = can_of[from];
        }
        if (timer_of[from] != NULL) {
            timer_of[from]->references++;
            timer_of[to] = timer_of[from];
        }
    }
    return to;
}

int close(int fd)
{
    can_t *can = can_at(fd);
    if (can != NULL && can->event_fd == fd && can->references > 1) { /* the queue's own descriptor goes, another name stays */
        for (int other = 0; other < FD_MAX; other++) {
            if (other != fd && can_of[other] == can) {
                can->event_fd = other;
            }
        }
    }
    forget(fd);
    return get_close()(fd);
}

int dup(int fd) { return share(fd, get_dup()(fd)); }

int dup2(int fd, int wanted)
{
    if (fd != wanted) {
        forget(wanted);
    }
    return share(fd, get_dup2()(fd, wanted));
}

int dup3(int fd, int wanted, int flags)
{
    if (fd != wanted) {
        forget(wanted);
    }
    return share(fd, get_dup3()(fd, wanted, flags));
}

int fcntl(int fd, int command, ...)
{
    va_list words;
    va_start(words, command);
    void *argument = va_arg(words, void *);
    va_end(words);
    int result = get_fcntl()(fd, command, argument);
    return command == F_DUPFD || command == F_DUPFD_CLOEXEC ? share(fd, result) : result;
}

int fcntl64(int fd, int command, ...)
{
    va_list words;
    va_start(words, command);
    void *argument = va_arg(words, void *);
    va_end(words);
    int result = get_fcntl64()(fd, command, argument);
    return command == F_DUPFD || command == F_DUPFD_CLOEXEC ? share(fd, result) : result;
}

static int64_t until_of(int64_t timeout_ns) { return timeout_ns < 0 ? VB_NEVER : now_ns() + timeout_ns; }

/* Ask the kernel without waiting, then sleep in virtual time, until something is ready or the time is over. */
#define WAIT_FOR_SEVERAL(ASK, TIMEOUT_NS)                      \
    do {                                                       \
        claim();                                               \
        int64_t until = until_of(TIMEOUT_NS);                  \
        for (;;) {                                             \
            int ready = (ASK);                                 \
            if (ready != 0) {                                  \
                return ready;                                  \
            }                                                  \
            if (now_ns() >= until) {                           \
                spend();                                       \
                return 0;                                      \
            }                                                  \
            if (!sleep_turn(until, true)) {                    \
                return -1;                                     \
            }                                                  \
        }                                                      \
    } while (0)

int poll(struct pollfd *items, nfds_t count, int timeout_ms)
{
    if (region == NULL) {
        return get_poll()(items, count, timeout_ms);
    }
    if (timeout_ms == 0 && !claimed) {
        return get_poll()(items, count, 0); /* a look at start-up, as the C library does it */
    }
    WAIT_FOR_SEVERAL(get_poll()(items, count, 0), timeout_ms < 0 ? -1 : (int64_t)timeout_ms * 1000000);
}

int __poll_chk(struct pollfd *items, nfds_t count, int timeout_ms, size_t room);
int __poll_chk(struct pollfd *items, nfds_t count, int timeout_ms, size_t room)
{
    (void)room;
    return poll(items, count, timeout_ms);
}

int ppoll(struct pollfd *items, nfds_t count, const struct timespec *limit, const sigset_t *mask)
{
    if (region == NULL) {
        return get_ppoll()(items, count, limit, mask);
    }
    WAIT_FOR_SEVERAL(get_poll()(items, count, 0), limit == NULL ? -1 : from_timespec(limit));
}

static int ask_select(int count, fd_set *reads, fd_set *writes, fd_set *errors, const fd_set kept[3])
{
    struct timeval none = {0, 0};
    if (reads != NULL) {
        *reads = kept[0];
    }
    if (writes != NULL) {
        *writes = kept[1];
    }
    if (errors != NULL) {
        *errors = kept[2];
    }
    return get_select()(count, reads, writes, errors, &none);
}

static int select_for(int count, fd_set *reads, fd_set *writes, fd_set *errors, int64_t timeout_ns)
{
    fd_set kept[3];
    FD_ZERO(&kept[0]);
    FD_ZERO(&kept[1]);
    FD_ZERO(&kept[2]);
    if (reads != NULL) {
        kept[0] = *reads;
    }
    if (writes != NULL) {
        kept[1] = *writes;
    }
    if (errors != NULL) {
        kept[2] = *errors;
    }
    WAIT_FOR_SEVERAL(ask_select(count, reads, writes, errors, kept), timeout_ns);
}

int select(int count, fd_set *restrict reads, fd_set *restrict writes, fd_set *restrict errors, struct timeval *restrict limit)
{
    if (region == NULL) {
        return get_select()(count, reads, writes, errors, limit);
    }
    return select_for(count, reads, writes, errors, limit == NULL ? -1 : (int64_t)limit->tv_sec * NS_PER_S + (int64_t)limit->tv_usec * 1000);
}

int pselect(int count, fd_set *restrict reads, fd_set *restrict writes, fd_set *restrict errors, const struct timespec *restrict limit,
            const sigset_t *restrict mask)
{
    if (region == NULL) {
        return get_pselect()(count, reads, writes, errors, limit, mask);
    }
    return select_for(count, reads, writes, errors, limit == NULL ? -1 : from_timespec(limit));
}

int epoll_wait(int fd, struct epoll_event *events, int count, int timeout_ms)
{
    if (region == NULL) {
        return get_epoll_wait()(fd, events, count, timeout_ms);
    }
    WAIT_FOR_SEVERAL(get_epoll_wait()(fd, events, count, 0), timeout_ms < 0 ? -1 : (int64_t)timeout_ms * 1000000);
}

int epoll_pwait(int fd, struct epoll_event *events, int count, int timeout_ms, const sigset_t *mask)
{
    if (region == NULL) {
        return get_epoll_pwait()(fd, events, count, timeout_ms, mask);
    }
    return epoll_wait(fd, events, count, timeout_ms);
}
