/*
 * Lets User Mode Linux before 6.13 run on processors with AMX.
 *
 * It restores the floating point registers of its processes with PTRACE_SETREGSET(NT_X86_XSTATE)
 * from an area of fixed size. A kernel takes nothing shorter than its own whole area, which AMX
 * makes larger than that, and User Mode Linux dies before its first process runs. Preloaded, this
 * completes a short area with what the process has there already: registers that User Mode Linux
 * does not know and whose use its processes cannot ask for.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

typedef long ptrace_t(enum __ptrace_request, ...);

long ptrace(enum __ptrace_request request, ...)
{
	static ptrace_t *of_libc;
	static char whole[1 << 16] __attribute__((aligned(64)));
	va_list rest;

	va_start(rest, request);
	pid_t pid = va_arg(rest, pid_t);
	void *addr = va_arg(rest, void *);
	void *data = va_arg(rest, void *);
	va_end(rest);

	if (!of_libc)
		of_libc = (ptrace_t *)dlsym(RTLD_NEXT, "ptrace");
	if (request == PTRACE_SETREGSET && addr == (void *)NT_X86_XSTATE) {
		const struct iovec *given = data;
		struct iovec present = {whole, sizeof whole};

		if (of_libc(PTRACE_GETREGSET, pid, addr, &present) == 0 &&
		    given->iov_len < present.iov_len) {
			memcpy(whole, given->iov_base, given->iov_len);
			return of_libc(request, pid, addr, &present);
		}
	}
	return of_libc(request, pid, addr, data);
}
