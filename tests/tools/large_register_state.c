/* Plays a host whose processor has a larger register state than this one (11,008 bytes, as with AMX): preloaded below register_state.c.
 *
 * As Linux does: a read gives as much as fits into the reader's buffer, the rest beyond the real state as zeros; a write that is not the
 * whole state is refused with EFAULT and changes nothing. Of a whole one the real processor gets the part it has.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

#define PLAYED_SIZE 11008

typedef long ptrace_function(enum __ptrace_request, ...);

static ptrace_function *libc_ptrace;
static unsigned char state[1 << 16];

__attribute__((constructor)) static void find_ptrace(void)
{
    libc_ptrace = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
}

static long read_state(pid_t pid, struct iovec *wanted)
{
    struct iovec real = {state, sizeof state};

    memset(state, 0, sizeof state);
    long result = libc_ptrace(PTRACE_GETREGSET, pid, (void *)(long)NT_X86_XSTATE, &real);
    if (result != 0)
        return result;
    if (wanted->iov_len > PLAYED_SIZE)
        wanted->iov_len = PLAYED_SIZE;
    memcpy(wanted->iov_base, state, wanted->iov_len);
    return 0;
}

static long write_state(pid_t pid, const struct iovec *given)
{
    struct iovec real = {state, sizeof state};

    if (given->iov_len != PLAYED_SIZE) {
        errno = EFAULT;
        return -1;
    }
    if (libc_ptrace(PTRACE_GETREGSET, pid, (void *)(long)NT_X86_XSTATE, &real) != 0)
        return -1;
    real.iov_base = given->iov_base;
    return libc_ptrace(PTRACE_SETREGSET, pid, (void *)(long)NT_X86_XSTATE, &real);
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list words;
    va_start(words, request);
    pid_t pid = va_arg(words, pid_t);
    void *address = va_arg(words, void *);
    void *data = va_arg(words, void *);
    va_end(words);

    if ((long)address == NT_X86_XSTATE && request == PTRACE_GETREGSET)
        return read_state(pid, data);
    if ((long)address == NT_X86_XSTATE && request == PTRACE_SETREGSET)
        return write_state(pid, data);
    return libc_ptrace(request, pid, address, data);
}
