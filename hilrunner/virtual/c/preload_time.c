/* Clocks, sleeps and timers of the program. */
#include "preload.h"

void set_timespec(struct timespec *out, int64_t ns)
{
    out->tv_sec = (time_t)(ns / NS_PER_S);
    out->tv_nsec = (long)(ns % NS_PER_S);
}

int64_t from_timespec(const struct timespec *in) { return (int64_t)in->tv_sec * NS_PER_S + in->tv_nsec; }

bool is_wall(clockid_t clock) { return clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE || clock == CLOCK_TAI; }

int clock_gettime(clockid_t clock, struct timespec *out)
{
    if (region == NULL || clock == CLOCK_PROCESS_CPUTIME_ID || clock == CLOCK_THREAD_CPUTIME_ID || clock < 0) {
        return get_clock_gettime()(clock, out);
    }
    spend();
    set_timespec(out, now_ns() + (is_wall(clock) ? region->real_minus_mono_ns : 0));
    return 0;
}

int gettimeofday(struct timeval *restrict out, void *restrict zone)
{
    if (region == NULL) {
        return get_gettimeofday()(out, zone);
    }
    spend();
    int64_t ns = now_ns() + region->real_minus_mono_ns;
    out->tv_sec = (time_t)(ns / NS_PER_S);
    out->tv_usec = (suseconds_t)(ns % NS_PER_S / 1000);
    return 0;
}

time_t time(time_t *out)
{
    if (region == NULL) {
        return get_time()(out);
    }
    time_t now = (time_t)((now_ns() + region->real_minus_mono_ns) / NS_PER_S);
    if (out != NULL) {
        *out = now;
    }
    return now;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *wanted, struct timespec *left)
{
    if (region == NULL) {
        return get_clock_nanosleep()(clock, flags, wanted, left);
    }
    if (wanted->tv_nsec < 0 || wanted->tv_nsec >= NS_PER_S) {
        return EINVAL;
    }
    claim();
    int64_t until = from_timespec(wanted);
    if (!(flags & TIMER_ABSTIME)) {
        until += now_ns();
    } else if (is_wall(clock)) {
        until -= region->real_minus_mono_ns;
    }
    if (until <= now_ns()) {
        spend();
        return 0;
    }
    while (now_ns() < until) { /* timers may wake it on the way */
        if (!sleep_turn(until, false)) {
            return EINTR;
        }
    }
    return 0;
}

int nanosleep(const struct timespec *wanted, struct timespec *left)
{
    if (region == NULL) {
        return get_nanosleep()(wanted, left);
    }
    int code = clock_nanosleep(CLOCK_MONOTONIC, 0, wanted, left);
    if (code != 0) {
        errno = code;
        return -1;
    }
    return 0;
}

int usleep(useconds_t us)
{
    struct timespec wanted;
    set_timespec(&wanted, (int64_t)us * 1000);
    return nanosleep(&wanted, NULL);
}

unsigned sleep(unsigned seconds)
{
    struct timespec wanted = {.tv_sec = (time_t)seconds};
    nanosleep(&wanted, NULL);
    return 0;
}

int setitimer(__itimer_which_t which, const struct itimerval *restrict value, struct itimerval *restrict old)
{
    if (region != NULL && which == ITIMER_REAL && (value->it_value.tv_sec || value->it_value.tv_usec)) {
        claim();
        refuse("it asks for a signal after a time (setitimer); use timerfd or clock_nanosleep");
    }
    return get_setitimer()(which, value, old);
}

int timer_settime(timer_t timer, int flags, const struct itimerspec *restrict value, struct itimerspec *restrict old)
{
    if (region != NULL) {
        claim();
        refuse("it asks for a signal after a time (timer_settime); use timerfd or clock_nanosleep");
    }
    return get_timer_settime()(timer, flags, value, old);
}

unsigned alarm(unsigned seconds)
{
    if (region != NULL && seconds > 0) {
        claim();
        refuse("it asks for a signal after a time (alarm); use timerfd or clock_nanosleep");
    }
    return get_alarm()(seconds);
}

int timerfd_create(int clock, int flags)
{
    if (region == NULL) {
        return get_timerfd_create()(clock, flags);
    }
    claim();
    int fd = eventfd(0, ((flags & TFD_NONBLOCK) ? EFD_NONBLOCK : 0) | ((flags & TFD_CLOEXEC) ? EFD_CLOEXEC : 0));
    if (fd < 0 || fd >= FD_MAX) {
        return fd < 0 ? fd : (get_close()(fd), errno = EMFILE, -1);
    }
    timer_t_ *timer = calloc(1, sizeof *timer);
    *timer = (timer_t_){.expiry_mono_ns = VB_NEVER, .clock = clock, .event_fd = fd, .references = 1};
    timer_of[fd] = timer;
    return fd;
}

timer_t_ *timer_at(int fd) { return fd >= 0 && fd < FD_MAX ? timer_of[fd] : NULL; }

int timerfd_gettime(int fd, struct itimerspec *out)
{
    timer_t_ *timer = timer_at(fd);
    if (timer == NULL) {
        return get_timerfd_gettime()(fd, out);
    }
    set_timespec(&out->it_value, timer->expiry_mono_ns == VB_NEVER ? 0 : timer->expiry_mono_ns - now_ns());
    set_timespec(&out->it_interval, timer->interval_ns);
    return 0;
}

int timerfd_settime(int fd, int flags, const struct itimerspec *value, struct itimerspec *old)
{
    timer_t_ *timer = timer_at(fd);
    if (timer == NULL) {
        return get_timerfd_settime()(fd, flags, value, old);
    }
    if (old != NULL) {
        timerfd_gettime(fd, old);
    }
    uint64_t spent;
    int mode = get_fcntl()(fd, F_GETFL, 0);
    get_fcntl()(fd, F_SETFL, (void *)(long)(mode | O_NONBLOCK));
    (void)!get_read()(fd, &spent, sizeof spent); /* setting a timer forgets its expirations */
    get_fcntl()(fd, F_SETFL, (void *)(long)mode);
    int64_t first = from_timespec(&value->it_value);
    timer->interval_ns = from_timespec(&value->it_interval);
    if (first == 0) {
        timer->expiry_mono_ns = VB_NEVER;
    } else if (flags & TFD_TIMER_ABSTIME) {
        timer->expiry_mono_ns = first - (is_wall(timer->clock) ? region->real_minus_mono_ns : 0);
    } else {
        timer->expiry_mono_ns = now_ns() + first;
    }
    run_timers();
    return 0;
}
