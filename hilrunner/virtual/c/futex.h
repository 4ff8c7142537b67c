/* Hand the turn over: a word in shared memory, looked at for a moment, then waited for in the kernel. */
#ifndef HILRUNNER_VIRTUAL_FUTEX_H
#define HILRUNNER_VIRTUAL_FUTEX_H

#include <linux/futex.h>
#include <stdint.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static inline void vb_pause(void)
{
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("yield");
#endif
}

/* Set the word and wake whoever waits for it. */
static inline void vb_store_and_wake(int32_t *word, int32_t value)
{
    __atomic_store_n(word, value, __ATOMIC_RELEASE);
    syscall(SYS_futex, word, FUTEX_WAKE, 1, NULL, NULL, 0);
}

/* Wait until the word is `wanted`, at most `limit_ns` of wall-clock time; 0, or -1 when the time is over.
 * `spins` looks come first: where both sides have a core of their own they save two system calls and a change of context. */
static inline int vb_wait_for(int32_t *word, int32_t wanted, int spins, int64_t limit_ns)
{
    for (int k = 0; k < spins; k++) {
        if (__atomic_load_n(word, __ATOMIC_ACQUIRE) == wanted) {
            return 0;
        }
        vb_pause();
    }
    struct timespec limit = {.tv_sec = (time_t)(limit_ns / 1000000000LL), .tv_nsec = (long)(limit_ns % 1000000000LL)};
    for (;;) {
        int32_t seen = __atomic_load_n(word, __ATOMIC_ACQUIRE);
        if (seen == wanted) {
            return 0;
        }
        if (syscall(SYS_futex, word, FUTEX_WAIT, seen, &limit, NULL, 0) < 0) {
            if (__atomic_load_n(word, __ATOMIC_ACQUIRE) == wanted) {
                return 0;
            }
            extern int *__errno_location(void);
            if (*__errno_location() == 110 /* ETIMEDOUT */) {
                return -1;
            }
        }
    }
}

#endif
