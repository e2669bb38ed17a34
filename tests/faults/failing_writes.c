/* Makes write, pwrite, writev, fsync and fdatasync fail for files below FAIL_FOLDER from the FAIL_AFTER-th call of a process on, with
   FAIL_WITH (EIO or ENOSPC). Preloaded by the fault tests. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

static long calls = 0;

static int fails(int handle) {
    const char *folder = getenv("FAIL_FOLDER"), *after = getenv("FAIL_AFTER"), *with = getenv("FAIL_WITH");
    char link[64], path[4096];
    if (!folder || !after || !with) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", handle);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    if (strncmp(path, folder, strlen(folder)) != 0) return 0;
    if (__sync_add_and_fetch(&calls, 1) < atol(after)) return 0;
    errno = strcmp(with, "EIO") == 0 ? EIO : ENOSPC;
    return 1;
}

ssize_t write(int handle, const void *data, size_t size) {
    static ssize_t (*real)(int, const void *, size_t);
    if (!real) real = dlsym(RTLD_NEXT, "write");
    return fails(handle) ? -1 : real(handle, data, size);
}

ssize_t pwrite64(int handle, const void *data, size_t size, off_t at) {
    static ssize_t (*real)(int, const void *, size_t, off_t);
    if (!real) real = dlsym(RTLD_NEXT, "pwrite64");
    return fails(handle) ? -1 : real(handle, data, size, at);
}

ssize_t pwrite(int handle, const void *data, size_t size, off_t at) { return pwrite64(handle, data, size, at); }

ssize_t writev(int handle, const struct iovec *parts, int count) {
    static ssize_t (*real)(int, const struct iovec *, int);
    if (!real) real = dlsym(RTLD_NEXT, "writev");
    return fails(handle) ? -1 : real(handle, parts, count);
}

int fsync(int handle) {
    static int (*real)(int);
    if (!real) real = dlsym(RTLD_NEXT, "fsync");
    return fails(handle) ? -1 : real(handle);
}

int fdatasync(int handle) {
    static int (*real)(int);
    if (!real) real = dlsym(RTLD_NEXT, "fdatasync");
    return fails(handle) ? -1 : real(handle);
}
