/* A disk that fails. Preloaded into a program, this counts the calls that change something below a folder, and at the n-th one
 * kills the process, or lets that one and all later ones fail. A write is cut in its middle, as a real one may be.
 *
 * In the environment: DISK_FOLDER, DISK_FAULT (count, kill, full, gone, read-only; removed: a person deletes all that is in the
 * folder just before the n-th call, and the disk stays well; or no-links: the disk is FAT, which knows neither links nor an
 * exchange of names, and fails at no call), DISK_CALL (n, from 1), and DISK_TRACE, a file
 * that exists: its first 8 bytes are the number of calls so far, of all processes of a command together; with `count` each call
 * is a line behind them. */
#define _GNU_SOURCE
#undef _FORTIFY_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum fault { OFF, COUNT, KILL, FULL, GONE, READ_ONLY, REMOVED, NO_LINKS };

static enum fault fault;
static const char *folder;
static long at;
static long *calls;
static int trace = -1;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) void failing_disk_arm(void) {
  const char *what = getenv("DISK_FAULT"), *where = getenv("DISK_FOLDER"), *number = getenv("DISK_CALL"), *file = getenv("DISK_TRACE");
  fault = OFF;
  if (!what || !where || !number || !file) return;
  trace = REAL(open)(file, O_RDWR | O_APPEND | O_CLOEXEC);
  calls = trace < 0 ? MAP_FAILED : mmap(NULL, 8, PROT_READ | PROT_WRITE, MAP_SHARED, trace, 0);
  if (calls == MAP_FAILED) return;
  folder = strdup(where);
  at = atol(number);
  fault = !strcmp(what, "count") ? COUNT : !strcmp(what, "kill") ? KILL : !strcmp(what, "full") ? FULL
        : !strcmp(what, "gone") ? GONE : !strcmp(what, "read-only") ? READ_ONLY : !strcmp(what, "removed") ? REMOVED
        : !strcmp(what, "no-links") ? NO_LINKS : OFF;
}

/* The path of a name in an open folder, or of an open file without a name. */
static void path_of(int fd, const char *name, char *out) {
  char link[64];
  ssize_t length = 0;
  out[0] = 0;
  if (name && name[0] == '/') {
    snprintf(out, PATH_MAX, "%s", name);
    return;
  }
  if (fd == AT_FDCWD) {
    if (!getcwd(out, PATH_MAX)) out[0] = 0;
  } else {
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    length = readlink(link, out, PATH_MAX - 1);
    out[length < 0 ? 0 : length] = 0;
  }
  if (name) {
    length = (ssize_t)strlen(out);
    snprintf(out + length, PATH_MAX - (size_t)length, "/%s", name);
  }
}

static int is_below(const char *path) {
  size_t length = strlen(folder);
  return !strncmp(path, folder, length) && (path[length] == '/' || path[length] == 0);
}

static int remove_one(const char *path, const struct stat *status, int kind, struct FTW *place) {
  (void)status, (void)kind;
  return place->level ? remove(path) : 0;
}

/* Count a call. Returns 0, or 1 for the n-th one, 2 for a later one. */
static int counted(const char *call, const char *path, const char *other) {
  long number = __atomic_add_fetch(calls, 1, __ATOMIC_SEQ_CST);
  if (fault == COUNT) {
    char line[2 * PATH_MAX + 64];
    int length = snprintf(line, sizeof line, "%s\t%s\t%s\n", call, path, other);
    if (REAL(write)(trace, line, (size_t)length) != length) abort();
    return 0;
  }
  if (fault == REMOVED) {
    int known = errno;
    if (number == at && nftw(folder, remove_one, 16, FTW_DEPTH | FTW_PHYS)) abort();
    errno = known;
    return 0;
  }
  return number < at ? 0 : number == at ? 1 : 2;
}

/* The error of a call that changes a file, 0 for none. `room`: it needs room on the disk. */
static int refused(const char *call, int fd, const char *name, int other_fd, const char *other, int room) {
  char path[PATH_MAX], second[PATH_MAX] = "";
  int when, known = errno;
  if (fault == OFF) return 0;
  path_of(fd, name, path);
  if (other) path_of(other_fd, other, second);
  errno = known;
  if (!is_below(path) && !(other && is_below(second))) return 0;
  when = counted(call, path, second);
  if (fault == NO_LINKS) return strcmp(call, "link") ? strcmp(call, "exchange") ? 0 : EINVAL : EPERM;
  if (!when) return 0;
  if (fault == KILL) raise(SIGKILL);
  return fault == GONE ? EIO : fault == READ_ONLY ? EROFS : room ? ENOSPC : 0;
}

#define FAIL(...) do { int code = refused(__VA_ARGS__); if (code) { errno = code; return -1; } } while (0)

static int open_at(const char *symbol, int fd, const char *name, int flags, mode_t mode) {
  int (*real)(int, const char *, int, ...) = (int (*)(int, const char *, int, ...))dlsym(RTLD_NEXT, symbol);
  if (flags & (O_CREAT | O_TRUNC) || (flags & O_ACCMODE) != O_RDONLY) {
    FAIL("open", fd, name, 0, NULL, (flags & O_CREAT) != 0);
  } else if (fault == GONE && *calls >= at) {
    char path[PATH_MAX];
    path_of(fd, name, path);
    if (is_below(path)) { errno = EIO; return -1; }
  }
  return real(fd, name, flags, mode);
}

#define MODE(flags, last) mode_t mode = 0; if ((flags) & (O_CREAT | O_TMPFILE)) { va_list rest; va_start(rest, last); mode = va_arg(rest, mode_t); va_end(rest); }
int open(const char *name, int flags, ...) { MODE(flags, flags) return open_at("openat", AT_FDCWD, name, flags, mode); }
int open64(const char *name, int flags, ...) { MODE(flags, flags) return open_at("openat64", AT_FDCWD, name, flags, mode); }
int openat(int fd, const char *name, int flags, ...) { MODE(flags, flags) return open_at("openat", fd, name, flags, mode); }
int openat64(int fd, const char *name, int flags, ...) { MODE(flags, flags) return open_at("openat64", fd, name, flags, mode); }

ssize_t write(int fd, const void *data, size_t size) {
  char path[PATH_MAX];
  ssize_t (*real)(int, const void *, size_t) = REAL(write);
  int when, known = errno;
  if (fault == OFF) return real(fd, data, size);
  path_of(fd, NULL, path);
  errno = known;
  if (!is_below(path)) return real(fd, data, size);
  when = counted("write", path, "");
  if (!when || fault == NO_LINKS) return real(fd, data, size);
  if (when == 1 && size > 1 && (fault == KILL || fault == FULL)) {
    ssize_t half = real(fd, data, size / 2);
    if (fault == FULL) return half;
  }
  if (fault == KILL) raise(SIGKILL);
  errno = fault == FULL ? ENOSPC : fault == GONE ? EIO : EROFS;
  return -1;
}

int fsync(int fd) { FAIL("fsync", fd, NULL, 0, NULL, 0); return REAL(fsync)(fd); }
int fdatasync(int fd) { FAIL("fsync", fd, NULL, 0, NULL, 0); return REAL(fdatasync)(fd); }
int fchmod(int fd, mode_t mode) { FAIL("chmod", fd, NULL, 0, NULL, 0); return REAL(fchmod)(fd, mode); }
int chmod(const char *name, mode_t mode) { FAIL("chmod", AT_FDCWD, name, 0, NULL, 0); return REAL(chmod)(name, mode); }
int ftruncate(int fd, off_t size) { FAIL("truncate", fd, NULL, 0, NULL, 0); return REAL(ftruncate)(fd, size); }
int ftruncate64(int fd, off64_t size) { FAIL("truncate", fd, NULL, 0, NULL, 0); return REAL(ftruncate64)(fd, size); }
int rename(const char *a, const char *b) { FAIL("rename", AT_FDCWD, a, AT_FDCWD, b, 0); return REAL(rename)(a, b); }
int renameat(int x, const char *a, int y, const char *b) { FAIL("rename", x, a, y, b, 0); return REAL(renameat)(x, a, y, b); }
int renameat2(int x, const char *a, int y, const char *b, unsigned how) { FAIL(how ? "exchange" : "rename", x, a, y, b, 0); return REAL(renameat2)(x, a, y, b, how); }
int link(const char *a, const char *b) { FAIL("link", AT_FDCWD, a, AT_FDCWD, b, 0); return REAL(link)(a, b); }
int linkat(int x, const char *a, int y, const char *b, int how) { FAIL("link", x, a, y, b, 0); return REAL(linkat)(x, a, y, b, how); }
int symlink(const char *a, const char *b) { FAIL("symlink", AT_FDCWD, b, 0, NULL, 1); return REAL(symlink)(a, b); }
int unlink(const char *a) { FAIL("unlink", AT_FDCWD, a, 0, NULL, 0); return REAL(unlink)(a); }
int unlinkat(int x, const char *a, int how) { FAIL("unlink", x, a, 0, NULL, 0); return REAL(unlinkat)(x, a, how); }
int rmdir(const char *a) { FAIL("rmdir", AT_FDCWD, a, 0, NULL, 0); return REAL(rmdir)(a); }
int mkdir(const char *a, mode_t mode) { FAIL("mkdir", AT_FDCWD, a, 0, NULL, 1); return REAL(mkdir)(a, mode); }
int mkdirat(int x, const char *a, mode_t mode) { FAIL("mkdir", x, a, 0, NULL, 1); return REAL(mkdirat)(x, a, mode); }
