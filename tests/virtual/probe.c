/* A firmware in miniature for each way in which a program may meet time and CAN: `probe NAME`; prints what it saw, one line a thing. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static int64_t now_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000 - 1000000000;
}

static void say(const char *what, long value)
{
    printf("%ld %s %ld\n", (long)now_us(), what, value);
    fflush(stdout);
}

static int open_named(const char *name)
{
    int fd = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(name)};
    if (fd < 0 || address.can_ifindex == 0 || bind(fd, (struct sockaddr *)&address, sizeof address) < 0) {
        perror("open");
        exit(1);
    }
    return fd;
}

static void send_id(int fd, uint32_t id)
{
    struct can_frame frame = {.can_id = id, .can_dlc = 2, .data = {1, 2}};
    say("sent", write(fd, &frame, sizeof frame));
}

/* The driver of the test sends frame 0x100 every 5 ms, the first at 5 ms. */

static void with_poll(void)
{
    int fd = open_named("vcan0");
    struct pollfd item = {.fd = fd, .events = POLLIN};
    say("poll", poll(&item, 1, 2));
    say("poll", poll(&item, 1, 10));
    say("readable", item.revents & POLLIN);
    struct can_frame frame;
    say("read", read(fd, &frame, sizeof frame));
    say("id", (long)frame.can_id);
    item.events = POLLOUT;
    say("writable", poll(&item, 1, 0));
}

static void with_select(void)
{
    int fd = open_named("vcan0");
    fd_set reads;
    FD_ZERO(&reads);
    FD_SET(fd, &reads);
    struct timeval limit = {.tv_usec = 2000};
    say("select", select(fd + 1, &reads, NULL, NULL, &limit));
    FD_SET(fd, &reads);
    limit = (struct timeval){.tv_usec = 20000};
    say("select", select(fd + 1, &reads, NULL, NULL, &limit));
    say("isset", FD_ISSET(fd, &reads) != 0);
}

static void with_epoll(void)
{
    int fd = open_named("vcan0"), set = epoll_create1(0), timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
    struct itimerspec every = {.it_value = {.tv_nsec = 3000000}, .it_interval = {.tv_nsec = 3000000}};
    timerfd_settime(timer, 0, &every, NULL);
    for (int k = 0; k < 2; k++) {
        struct epoll_event item = {.events = EPOLLIN, .data.fd = k == 0 ? fd : timer};
        epoll_ctl(set, EPOLL_CTL_ADD, item.data.fd, &item);
    }
    for (int k = 0; k < 6; k++) {
        struct epoll_event found;
        int count = epoll_wait(set, &found, 1, 100);
        struct can_frame frame;
        uint64_t expired = 0;
        if (count == 1 && found.data.fd == timer) {
            (void)!read(timer, &expired, sizeof expired);
            say("timer", (long)expired);
        } else if (count == 1) {
            say("frame", recv(fd, &frame, sizeof frame, MSG_DONTWAIT));
        }
    }
}

static void with_timer(void)
{
    int timer = timerfd_create(CLOCK_MONOTONIC, 0);
    struct itimerspec every = {.it_value = {.tv_nsec = 1000000}, .it_interval = {.tv_nsec = 2000000}};
    timerfd_settime(timer, 0, &every, NULL);
    uint64_t expired;
    say("size", read(timer, &expired, sizeof expired));
    say("count", (long)expired);
    struct timespec nap = {.tv_nsec = 7000000};
    nanosleep(&nap, NULL);
    say("size", read(timer, &expired, sizeof expired));
    say("count", (long)expired);
}

static void with_message(void)
{
    int fd = open_named("vcan0"), one = 1;
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &one, sizeof one);
    struct can_frame frame;
    struct iovec piece = {.iov_base = &frame, .iov_len = sizeof frame};
    struct sockaddr_can from;
    char control[128];
    struct msghdr message = {.msg_name = &from, .msg_namelen = sizeof from, .msg_iov = &piece, .msg_iovlen = 1,
                             .msg_control = control, .msg_controllen = sizeof control};
    say("size", recvmsg(fd, &message, 0));
    say("interface", from.can_ifindex == (int)if_nametoindex("vcan0"));
    struct cmsghdr *head = CMSG_FIRSTHDR(&message);
    struct timespec stamp = {0};
    if (head != NULL && head->cmsg_type == SCM_TIMESTAMPNS) {
        memcpy(&stamp, CMSG_DATA(head), sizeof stamp);
    }
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    say("age_ns", (long)((now.tv_sec - stamp.tv_sec) * 1000000000 + now.tv_nsec - stamp.tv_nsec));
}

static void with_filters(void)
{
    int fd = open_named("vcan0"), other = open_named("vcan0"), one = 1;
    struct can_filter wanted[] = {{.can_id = 0x321, .can_mask = CAN_SFF_MASK}};
    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, wanted, sizeof wanted);
    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &one, sizeof one);
    struct can_frame frame;
    usleep(12000);
    say("filtered", recv(fd, &frame, sizeof frame, MSG_DONTWAIT));
    send_id(fd, 0x321);
    send_id(fd, 0x322);
    usleep(1000);
    say("own", recv(fd, &frame, sizeof frame, MSG_DONTWAIT));
    say("again", recv(fd, &frame, sizeof frame, MSG_DONTWAIT));
    int heard = 0;
    while (recv(other, &frame, sizeof frame, MSG_DONTWAIT) == sizeof frame) {
        heard += frame.can_id >= 0x321;
    }
    say("looped", heard);
}

static void with_time_out(void)
{
    int fd = open_named("vcan0");
    struct can_filter none[] = {{.can_id = 0x7ff, .can_mask = CAN_SFF_MASK}};
    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, none, sizeof none);
    struct timeval limit = {.tv_usec = 4000};
    setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
    struct can_frame frame;
    long got = recv(fd, &frame, sizeof frame, 0);
    say("timed out", got < 0 && errno == EAGAIN);
}

static void with_dup(void)
{
    int first = open_named("vcan0"), second = dup(first);
    close(first);
    struct can_frame frame;
    say("dup", recv(second, &frame, sizeof frame, 0));
    say("closed", recv(first, &frame, sizeof frame, MSG_DONTWAIT));
}

static void with_busy_look(void)
{
    int fd = open_named("vcan0");
    struct can_frame frame;
    while (recv(fd, &frame, sizeof frame, MSG_DONTWAIT) < 0) {
    }
    say("got", now_us() >= 5000);
    int64_t from = now_us();
    while (now_us() < from + 2000) {
    }
    say("passed", now_us() - from >= 2000);
}

static void with_flood(void)
{
    int fd = open_named("vcan0");
    struct can_frame frame = {.can_id = 0x10, .can_dlc = 0};
    int sent = 0;
    while (write(fd, &frame, sizeof frame) == sizeof frame) {
        sent++;
    }
    say("no buffer space", errno == ENOBUFS && sent > 10);
    usleep(1000);
    say("room again", write(fd, &frame, sizeof frame));
}

static void with_clocks(void)
{
    struct timespec one = {0};
    struct timeval two;
    clock_gettime(CLOCK_REALTIME, &one);
    gettimeofday(&two, NULL);
    say("same", one.tv_sec == two.tv_sec && one.tv_nsec / 1000 == two.tv_usec && time(NULL) == one.tv_sec);
    sleep(1);
    struct timespec three, wanted;
    clock_gettime(CLOCK_REALTIME, &three);
    say("second", three.tv_sec - one.tv_sec);
    wanted = three;
    wanted.tv_sec += 2;
    clock_nanosleep(CLOCK_REALTIME, TIMER_ABSTIME, &wanted, NULL);
    clock_gettime(CLOCK_REALTIME, &one);
    say("absolute", one.tv_sec - three.tv_sec);
}

static void *sleeper(void *unused)
{
    usleep(1000);
    return unused;
}

static void with_thread(void)
{
    pthread_t thread;
    usleep(1000);
    pthread_create(&thread, NULL, sleeper, NULL);
    pthread_join(thread, NULL);
    say("joined", 0);
}

static void with_fork(void)
{
    usleep(1000);
    if (fork() == 0) {
        usleep(1000);
        _exit(0);
    }
    int status;
    wait(&status);
    say("child", WEXITSTATUS(status));
}

static void with_alarm(void)
{
    usleep(1000);
    alarm(1);
    say("alarm", 0);
}

static void with_broadcast(void)
{
    long got = socket(PF_CAN, SOCK_DGRAM, CAN_BCM);
    say("no such protocol", got < 0 && errno == EPROTONOSUPPORT);
}

static void with_hang(void)
{
    usleep(1000);
    for (volatile long k = 0;; k++) {
    }
}

static void with_two_buses(void)
{
    int one = open_named("vcan0"), two = open_named("vcan1");
    struct can_frame frame;
    usleep(6000);
    say("first", recv(one, &frame, sizeof frame, MSG_DONTWAIT));
    say("second", recv(two, &frame, sizeof frame, MSG_DONTWAIT));
}

/* Two sources ask for the bus at the same moment: the lower identifier comes first. */
static void with_arbitration(void)
{
    int fd = open_named("vcan0"), one = 1;
    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &one, sizeof one);
    usleep(1000);
    send_id(fd, 0x500); /* begins at once */
    send_id(fd, 0x400);
    send_id(fd, 0x050);
    struct can_frame frame;
    for (int k = 0; k < 3; k++) {
        recv(fd, &frame, sizeof frame, 0);
        say("complete", (long)frame.can_id);
    }
}

int main(int count, char **words)
{
    static const struct {
        const char *name;
        void (*run)(void);
    } ways[] = {{"poll", with_poll}, {"select", with_select}, {"epoll", with_epoll}, {"timer", with_timer},
                {"message", with_message}, {"filters", with_filters}, {"timeout", with_time_out}, {"dup", with_dup},
                {"busy", with_busy_look}, {"flood", with_flood}, {"clocks", with_clocks}, {"thread", with_thread},
                {"fork", with_fork}, {"alarm", with_alarm}, {"broadcast", with_broadcast}, {"hang", with_hang},
                {"buses", with_two_buses}, {"arbitration", with_arbitration}};
    for (size_t k = 0; k < sizeof ways / sizeof ways[0]; k++) {
        if (count == 2 && strcmp(words[1], ways[k].name) == 0) {
            ways[k].run();
            return 0;
        }
    }
    return 2;
}
