/* Preloaded library that lets the n-th file operation below a folder fail, write half, or end the process.

   Operations are counted after fault_arm() and only for paths below its folder: creating, writing, renaming, linking,
   deleting, syncing, changing the length or mode, closing what was open for writing. gcc -shared -fPIC fault.c -ldl */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { NONE, ENOSPC_ONCE, ENOSPC_ON, EIO_ONCE, EIO_ON, SHORT, RENAME, KILL, TORN };
#define FDS 4096
static int kind = NONE;
static long at, count;
static char root[PATH_MAX], trace[1 << 20];
static size_t root_size, traced;
static unsigned char mine[FDS]; /* 1: below the folder, 2: open for writing, too */

void fault_arm(const char *folder, int what, long n) {
    snprintf(root, sizeof root, "%s", folder);
    root_size = strlen(root);
    memset(mine, 0, sizeof mine);
    kind = what; at = n; count = 0; traced = 0; trace[0] = 0;
}
void fault_disarm(void) { root_size = 0; }
long fault_count(void) { return count; }
const char *fault_trace(void) { return trace; }

static int below(int dir, const char *path) {
    char full[2 * PATH_MAX], link[64];
    if (!root_size || !path) return 0;
    if (path[0] == '/') snprintf(full, sizeof full, "%s", path);
    else if (dir == AT_FDCWD) {
        if (syscall(SYS_getcwd, full, (size_t)PATH_MAX) < 0) return 0;
        strcat(full, "/"); strncat(full, path, PATH_MAX - 1);
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", dir);
        ssize_t n = syscall(SYS_readlinkat, AT_FDCWD, link, full, (size_t)PATH_MAX);
        if (n < 0) return 0;
        full[n] = 0; strcat(full, "/"); strncat(full, path, PATH_MAX - 1);
    }
    return !strncmp(full, root, root_size) && (full[root_size] == '/' || !full[root_size]);
}
static int of_fd(int fd) { return root_size && fd >= 0 && fd < FDS ? mine[fd] : 0; }

enum { REAL, FAIL, HALF, HALF_THEN_KILL };
/* Count an operation. needs_space: a full disk refuses it. writes: it has a length that can be cut. */
static int step(const char *op, int needs_space, int writes) {
    count++;
    if (traced + strlen(op) + 2 < sizeof trace) traced += sprintf(trace + traced, "%s ", op);
    int here = count == at, from = at && count >= at;
    switch (kind) {
    case ENOSPC_ONCE: if (here && needs_space) { errno = ENOSPC; return FAIL; } break;
    case ENOSPC_ON:
        if (from && needs_space) { if (writes && here) return HALF; errno = ENOSPC; return FAIL; } break;
    case EIO_ONCE: if (here) { errno = EIO; return FAIL; } break;
    case EIO_ON: if (from) { errno = EIO; return FAIL; } break;
    case SHORT: if (here && writes) return HALF; break;
    case RENAME: if (from && (!strcmp(op, "rename") || !strcmp(op, "link"))) { errno = EACCES; return FAIL; } break;
    case KILL: if (here) kill(getpid(), SIGKILL); break;
    case TORN: if (here) { if (!writes) kill(getpid(), SIGKILL); return HALF_THEN_KILL; } break;
    }
    return REAL;
}
#define NEXT(name) static __typeof__(&name) next; if (!next) next = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

static int opened(int fd, int yes, int flags) {
    if (fd >= 0 && fd < FDS) mine[fd] = !yes ? 0 : (flags & O_ACCMODE) != O_RDONLY ? 2 : 1;
    return fd;
}
#define OPEN(name, ARGS, CALL, CALL_MODE, DIR) \
    int name ARGS { \
        static __typeof__(&name) next; if (!next) next = (__typeof__(&name))dlsym(RTLD_NEXT, #name); \
        int mode = 0, yes = below(DIR, path); \
        if (flags & (O_CREAT | __O_TMPFILE)) { va_list a; va_start(a, flags); mode = va_arg(a, int); va_end(a); } \
        if (yes && ((flags & O_ACCMODE) != O_RDONLY || flags & O_CREAT) && step("open", flags & O_CREAT, 0)) return -1; \
        return opened(mode || flags & (O_CREAT | __O_TMPFILE) ? CALL_MODE : CALL, yes, flags); \
    }
OPEN(open, (const char *path, int flags, ...), next(path, flags), next(path, flags, mode), AT_FDCWD)
OPEN(open64, (const char *path, int flags, ...), next(path, flags), next(path, flags, mode), AT_FDCWD)
OPEN(openat, (int dir, const char *path, int flags, ...), next(dir, path, flags), next(dir, path, flags, mode), dir)
OPEN(openat64, (int dir, const char *path, int flags, ...), next(dir, path, flags), next(dir, path, flags, mode), dir)

int close(int fd) {
    NEXT(close);
    int was = of_fd(fd);
    if (fd >= 0 && fd < FDS) mine[fd] = 0;
    int fails = was == 2 && step("close", 0, 0);
    int error = errno, done = next(fd);
    if (fails) { errno = error; return -1; }
    return done;
}
static ssize_t finish(int how, ssize_t done) { if (how == HALF_THEN_KILL) kill(getpid(), SIGKILL); return done; }
#define CUT(n) (how >= HALF && (n) > 1 ? (n) / 2 : (n))
ssize_t write(int fd, const void *data, size_t n) {
    NEXT(write);
    int how = of_fd(fd) ? step("write", 1, 1) : REAL;
    return how == FAIL ? -1 : finish(how, next(fd, data, CUT(n)));
}
ssize_t pwrite(int fd, const void *data, size_t n, off_t o) {
    NEXT(pwrite);
    int how = of_fd(fd) ? step("write", 1, 1) : REAL;
    return how == FAIL ? -1 : finish(how, next(fd, data, CUT(n), o));
}
ssize_t pwrite64(int fd, const void *data, size_t n, off64_t o) {
    NEXT(pwrite64);
    int how = of_fd(fd) ? step("write", 1, 1) : REAL;
    return how == FAIL ? -1 : finish(how, next(fd, data, CUT(n), o));
}
ssize_t writev(int fd, const struct iovec *v, int n) {
    NEXT(writev);
    int how = of_fd(fd) ? step("write", 1, 1) : REAL;
    if (how >= HALF && n) return finish(how, write(fd, v[0].iov_base, CUT(v[0].iov_len)));
    return how == FAIL ? -1 : next(fd, v, n);
}
ssize_t sendfile(int out, int in, off_t *o, size_t n) {
    NEXT(sendfile);
    int how = of_fd(out) ? step("write", 1, 1) : REAL;
    return how == FAIL ? -1 : finish(how, next(out, in, o, how >= HALF ? 100 : n));
}
ssize_t sendfile64(int out, int in, off64_t *o, size_t n) {
    NEXT(sendfile64);
    int how = of_fd(out) ? step("write", 1, 1) : REAL;
    return how == FAIL ? -1 : finish(how, next(out, in, o, how >= HALF ? 100 : n));
}
ssize_t copy_file_range(int in, off64_t *i, int out, off64_t *o, size_t n, unsigned f) {
    NEXT(copy_file_range);
    int how = of_fd(out) ? step("write", 1, 1) : REAL;
    return how == FAIL ? -1 : finish(how, next(in, i, out, o, how >= HALF ? 100 : n, f));
}
#define FD(name, op, space, ARGS, CALL) \
    int name ARGS { NEXT(name); if (of_fd(fd) && step(op, space, 0) == FAIL) return -1; return CALL; }
FD(fsync, "fsync", 1, (int fd), next(fd))
FD(fdatasync, "fsync", 1, (int fd), next(fd))
FD(ftruncate, "truncate", 0, (int fd, off_t n), next(fd, n))
FD(ftruncate64, "truncate", 0, (int fd, off64_t n), next(fd, n))
FD(fallocate, "allocate", 1, (int fd, int m, off_t o, off_t n), next(fd, m, o, n))
FD(fchmod, "mode", 0, (int fd, mode_t m), next(fd, m))
#define PATH(name, op, space, DIR, ARGS, CALL) \
    int name ARGS { NEXT(name); if (below(DIR, path) && step(op, space, 0) == FAIL) return -1; return CALL; }
PATH(rename, "rename", 1, AT_FDCWD, (const char *old, const char *path), next(old, path))
PATH(renameat, "rename", 1, dir, (int from, const char *old, int dir, const char *path), next(from, old, dir, path))
PATH(renameat2, "rename", 1, dir, (int from, const char *old, int dir, const char *path, unsigned f), next(from, old, dir, path, f))
PATH(link, "link", 1, AT_FDCWD, (const char *old, const char *path), next(old, path))
PATH(linkat, "link", 1, dir, (int from, const char *old, int dir, const char *path, int f), next(from, old, dir, path, f))
PATH(unlink, "unlink", 0, AT_FDCWD, (const char *path), next(path))
PATH(unlinkat, "unlink", 0, dir, (int dir, const char *path, int f), next(dir, path, f))
PATH(rmdir, "unlink", 0, AT_FDCWD, (const char *path), next(path))
PATH(mkdir, "mkdir", 1, AT_FDCWD, (const char *path, mode_t m), next(path, m))
PATH(mkdirat, "mkdir", 1, dir, (int dir, const char *path, mode_t m), next(dir, path, m))
