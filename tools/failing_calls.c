/* A library to be preloaded (LD_PRELOAD) that lets chosen system calls of a program fail: the n-th of them, so many times, or for good.
 *
 * Settings are environment variables, read once when the program starts:
 *   FAILING_CALL    name of one of the functions below
 *   FAILING_FROM    the first call that fails, counted from 1
 *   FAILING_COUNT   how many fail from there on; -1: all
 *   FAILING_ERRNO   errno they fail with
 *   FAILING_IN      only in a process whose command line contains this text; empty: in every process
 *   FAILING_THREAD  any, main, or other (every thread but the first); calls of other threads are not counted
 *   FAILING_ONCE    a path: calls count from when something lies there; empty: from the start
 *   FAILING_REPORT  a file to which each process that counted adds a line at its end: name, calls counted, calls failed
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <sched.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static char wanted[64];
static long first = 1, many = -1;
static int code = EIO, threads = 0; /* threads: 0 any, 1 main, 2 other */
static int chosen = 0;
static atomic_long counted, failed;

static long number(const char *name, long otherwise)
{
    const char *text = getenv(name);
    return text && *text ? atol(text) : otherwise;
}

__attribute__((constructor)) static void settle(void)
{
    const char *name = getenv("FAILING_CALL"), *where = getenv("FAILING_IN"), *which = getenv("FAILING_THREAD");
    char line[4096] = "";
    size_t size = 0;
    FILE *file = fopen("/proc/self/cmdline", "r");
    if (file) {
        size = fread(line, 1, sizeof line - 1, file);
        fclose(file);
    }
    for (size_t k = 0; k < size; k++)
        if (!line[k])
            line[k] = ' ';
    first = number("FAILING_FROM", 1);
    many = number("FAILING_COUNT", -1);
    code = (int)number("FAILING_ERRNO", EIO);
    threads = which && !strcmp(which, "main") ? 1 : which && !strcmp(which, "other") ? 2 : 0;
    if (name && strlen(name) < sizeof wanted)
        strcpy(wanted, name);
    chosen = *wanted && (!where || !*where || strstr(line, where));
}

__attribute__((destructor)) static void report(void)
{
    const char *path = getenv("FAILING_REPORT");
    FILE *file;
    if (!chosen || !path || !*path || !atomic_load(&counted))
        return;
    chosen = 0; /* what the report itself needs does not fail */
    file = fopen(path, "a");
    if (file) {
        fprintf(file, "%s %ld %ld\n", wanted, atomic_load(&counted), atomic_load(&failed));
        fclose(file);
    }
}

static int fails(const char *name)
{
    const char *once = getenv("FAILING_ONCE");
    long place;
    if (!chosen || strcmp(name, wanted))
        return 0;
    if (once && *once && access(once, F_OK))
        return 0;
    if (threads && (syscall(SYS_gettid) == getpid()) != (threads == 1))
        return 0;
    place = atomic_fetch_add(&counted, 1) + 1;
    if (place < first || (many >= 0 && place >= first + many))
        return 0;
    atomic_fetch_add(&failed, 1);
    return 1;
}

#define REAL(name) ((__typeof__(&name))real(#name, &real_##name))
static void *real(const char *name, void **kept)
{
    if (!*kept)
        *kept = dlsym(RTLD_NEXT, name);
    return *kept;
}

#define INTERPOSED(type, name, parameters, arguments, failure) \
    static void *real_##name; \
    type name parameters \
    { \
        if (fails(#name)) { \
            errno = code; \
            return failure; \
        } \
        return REAL(name) arguments; \
    }

/* of the loop */
INTERPOSED(int, clock_gettime, (clockid_t which, struct timespec *time), (which, time), -1)
INTERPOSED(int, clock_nanosleep, (clockid_t which, int flags, const struct timespec *time, struct timespec *rest), (which, flags, time, rest), code)
INTERPOSED(int, recvmmsg, (int fd, struct mmsghdr *messages, unsigned count, int flags, struct timespec *limit), (fd, messages, count, flags, limit), -1)
INTERPOSED(int, sendmmsg, (int fd, struct mmsghdr *messages, unsigned count, int flags), (fd, messages, count, flags), -1)
INTERPOSED(int, getrusage, (__rusage_who_t who, struct rusage *usage), (who, usage), -1)
INTERPOSED(int, sched_getcpu, (void), (), -1)
INTERPOSED(ssize_t, pread, (int fd, void *data, size_t size, off_t at), (fd, data, size, at), -1)
/* of the recorder, and of the set-up before it */
static int is_file(int fd)
{
    struct stat found;
    return !fstat(fd, &found) && S_ISREG(found.st_mode);
}

/* "disk_write" means writes to files only: a disk that breaks leaves pipes alone */
static void *real_write;
ssize_t write(int fd, const void *data, size_t size)
{
    if (fails("write") || (!strcmp(wanted, "disk_write") && is_file(fd) && fails("disk_write"))) {
        errno = code;
        return -1;
    }
    return REAL(write)(fd, data, size);
}

INTERPOSED(ssize_t, read, (int fd, void *data, size_t size), (fd, data, size), -1)
INTERPOSED(int, fallocate, (int fd, int mode, off_t at, off_t size), (fd, mode, at, size), -1)
INTERPOSED(int, ftruncate, (int fd, off_t size), (fd, size), -1)
INTERPOSED(int, ftruncate64, (int fd, off_t size), (fd, size), -1)
INTERPOSED(off_t, lseek, (int fd, off_t at, int from), (fd, at, from), -1)
INTERPOSED(off_t, lseek64, (int fd, off_t at, int from), (fd, at, from), -1)
INTERPOSED(int, poll, (struct pollfd *fds, nfds_t count, int limit), (fds, count, limit), -1)
INTERPOSED(int, memfd_create, (const char *name, unsigned flags), (name, flags), -1)
INTERPOSED(int, close, (int fd), (fd), -1)
