/* Preloaded into an unmodified firmware: stands in for the few libc calls by which such a program meets time and CAN.
 *
 * The program sees a Linux with the SocketCAN interfaces of the shared region (virtual_bus.h) and a clock that moves only while every node
 * sleeps. A CAN socket is an eventfd that is readable while frames wait: poll, select and epoll of the kernel then tell the truth about it,
 * asked without waiting; a wait itself is a turn given back to the bench. Timers (timerfd) are eventfds in the same way.
 *
 * One thread meets time. What cannot be followed (a second such thread, a fork that meets time, interval timers, other CAN protocols) is
 * refused: the reason goes to the bench in the node's `text`, and the process ends with 125. Never silently wrong.
 *
 * Environment: HILRUNNER_VIRTUAL_REGION (path of the region under /proc/<pid>/fd or a file), HILRUNNER_VIRTUAL_NODE (index). */
#ifndef HILRUNNER_VIRTUAL_PRELOAD_H
#define HILRUNNER_VIRTUAL_PRELOAD_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <linux/sockios.h>
#include <net/if.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <sys/uio.h>
#include <unistd.h>
#include "futex.h"
#include "virtual_bus.h"

#define REFUSED_EXIT 125
#define FD_MAX 1024
#define FILTERS_MAX 64
#define QUEUE_SIZE 1024
#define NS_PER_S 1000000000LL
#define FIRST_INDEX 3           /* interface index of the first bus; 1 is lo */
#define FREE_CALLS 2000         /* calls at one moment that take no time; a program that polls without sleeping sees time move after them */
#define CALL_COST_NS 1000
#define FOREVER_NS (24LL * 3600 * NS_PER_S)
#define SPINS 300
#define STOPPED_SLEEPS 100 /* after the end a program may try to sleep this often before it is ended hard */

typedef struct {
    int references;  /* descriptors that share it (dup) */
    int bus;         /* -1: not bound; -2: all */
    bool own, loopback, fd_frames, timestamp, timestamp_ns, closed;
    int64_t receive_timeout_ns; /* 0: none */
    struct can_filter filter[FILTERS_MAX];
    int filter_count;
    bool join_filters;
    vb_frame_t *queue;
    uint64_t written, read, dropped;
    int event_fd;
} can_t;

typedef struct {
    int64_t expiry_mono_ns; /* VB_NEVER: disarmed */
    int64_t interval_ns;
    int clock;
    int event_fd;
    int references;
} timer_t_;

/* Shared by the parts of this library and by nobody else. */
#pragma GCC visibility push(hidden)

extern vb_region_t *region; /* NULL: not started by a bench; every call is the C library's own */
extern vb_node_t *node;
extern can_t *can_of[FD_MAX];
extern timer_t_ *timer_of[FD_MAX];
extern bool claimed;

void refuse(const char *what);
void claim(void);
int64_t now_ns(void);
void spend(void);
bool sleep_turn(int64_t until_mono_ns, bool on_frame);
void run_timers(void);
void give_back(void);
can_t *can_at(int fd);
timer_t_ *timer_at(int fd);
bool seen_before(int fd);
void enqueue(can_t *can, const vb_frame_t *frame);
int bus_of_index(int index);
bool is_nonblocking(int fd, int flags);
bool is_wall(clockid_t clock);
void set_timespec(struct timespec *out, int64_t ns);
int64_t from_timespec(const struct timespec *in);

#pragma GCC visibility pop

/* The C library's own function of a name, looked up when it is first needed. */
#define REAL(result, name, ...)                                   \
    static result (*real_##name)(__VA_ARGS__);                    \
    static inline result (*get_##name(void))(__VA_ARGS__)                \
    {                                                             \
        if (real_##name == NULL) {                                \
            *(void **)&real_##name = dlsym(RTLD_NEXT, #name);     \
        }                                                         \
        return real_##name;                                       \
    }

REAL(int, clock_gettime, clockid_t, struct timespec *)
REAL(int, gettimeofday, struct timeval *, void *)
REAL(time_t, time, time_t *)
REAL(int, clock_nanosleep, clockid_t, int, const struct timespec *, struct timespec *)
REAL(int, nanosleep, const struct timespec *, struct timespec *)
REAL(int, socket, int, int, int)
REAL(int, bind, int, const struct sockaddr *, socklen_t)
REAL(int, setsockopt, int, int, int, const void *, socklen_t)
REAL(int, getsockopt, int, int, int, void *, socklen_t *)
REAL(int, getsockname, int, struct sockaddr *, socklen_t *)
REAL(int, connect, int, const struct sockaddr *, socklen_t)
REAL(ssize_t, read, int, void *, size_t)
REAL(ssize_t, write, int, const void *, size_t)
REAL(ssize_t, readv, int, const struct iovec *, int)
REAL(ssize_t, writev, int, const struct iovec *, int)
REAL(ssize_t, recv, int, void *, size_t, int)
REAL(ssize_t, recvfrom, int, void *, size_t, int, struct sockaddr *, socklen_t *)
REAL(ssize_t, recvmsg, int, struct msghdr *, int)
REAL(int, recvmmsg, int, struct mmsghdr *, unsigned, int, struct timespec *)
REAL(ssize_t, send, int, const void *, size_t, int)
REAL(ssize_t, sendto, int, const void *, size_t, int, const struct sockaddr *, socklen_t)
REAL(ssize_t, sendmsg, int, const struct msghdr *, int)
REAL(int, sendmmsg, int, struct mmsghdr *, unsigned, int)
REAL(int, close, int)
REAL(int, dup, int)
REAL(int, dup2, int, int)
REAL(int, dup3, int, int, int)
REAL(int, ioctl, int, unsigned long, void *)
REAL(int, fcntl, int, int, void *)
REAL(int, fcntl64, int, int, void *)
REAL(int, poll, struct pollfd *, nfds_t, int)
REAL(int, ppoll, struct pollfd *, nfds_t, const struct timespec *, const sigset_t *)
REAL(int, select, int, fd_set *, fd_set *, fd_set *, struct timeval *)
REAL(int, pselect, int, fd_set *, fd_set *, fd_set *, const struct timespec *, const sigset_t *)
REAL(int, epoll_wait, int, struct epoll_event *, int, int)
REAL(int, epoll_pwait, int, struct epoll_event *, int, int, const sigset_t *)
REAL(int, timerfd_create, int, int)
REAL(int, timerfd_settime, int, int, const struct itimerspec *, struct itimerspec *)
REAL(int, timerfd_gettime, int, struct itimerspec *)
REAL(unsigned, if_nametoindex, const char *)
REAL(char *, if_indextoname, unsigned, char *)
REAL(int, setitimer, __itimer_which_t, const struct itimerval *, struct itimerval *)
REAL(int, timer_settime, timer_t, int, const struct itimerspec *, struct itimerspec *)
REAL(unsigned, alarm, unsigned)
REAL(void, _exit, int)

#endif
