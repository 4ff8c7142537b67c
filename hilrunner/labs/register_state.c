/* Stands in for libc's ptrace in the kernel of User-Mode Linux, which is an ordinary program (LD_PRELOAD; built by preload.py).
 *
 * That kernel keeps 2,696 bytes of a process' floating-point registers and writes them back before the process goes on. Linux takes
 * such a write only if it is the processor's whole register state; with AMX that is 11,008 bytes, a short write is EFAULT, and the
 * user-mode kernel dies at boot. Kernels from 6.13 on size their buffer by the host; distributions carry older ones.
 *
 * So a refused write is made whole: read the state that is there, lay the short one over its beginning (the layout is the same from
 * its start on), write it all. Where the short write is accepted nothing changes, and every other request passes through.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

#ifndef NT_X86_XSTATE
#define NT_X86_XSTATE 0x202
#endif

typedef long ptrace_function(enum __ptrace_request, ...);

static ptrace_function *libc_ptrace;
/* One buffer is enough: the user-mode kernel has one processor, and only its own thread traces. Larger than any state of x86 today. */
static _Alignas(64) unsigned char whole_state[1 << 16];

/* Before the first instruction of the kernel, which brings memory management of its own. */
__attribute__((constructor)) static void find_ptrace(void)
{
    libc_ptrace = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
}

static long write_whole_state(pid_t pid, const struct iovec *part)
{
    struct iovec whole = {whole_state, sizeof whole_state};

    if (libc_ptrace(PTRACE_GETREGSET, pid, (void *)(long)NT_X86_XSTATE, &whole) != 0)
        return -1;
    if (whole.iov_len <= part->iov_len) { /* not too short: it was refused for something else */
        errno = EFAULT;
        return -1;
    }
    memcpy(whole_state, part->iov_base, part->iov_len);
    return libc_ptrace(PTRACE_SETREGSET, pid, (void *)(long)NT_X86_XSTATE, &whole);
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list words;
    va_start(words, request);
    pid_t pid = va_arg(words, pid_t);
    void *address = va_arg(words, void *);
    void *data = va_arg(words, void *);
    va_end(words);

    /* libc's own function, not the system call: the three PEEK requests give what they read as the result */
    long result = libc_ptrace(request, pid, address, data);
    if (result == -1 && errno == EFAULT && request == PTRACE_SETREGSET && (long)address == NT_X86_XSTATE)
        return write_whole_state(pid, data);
    return result;
}
