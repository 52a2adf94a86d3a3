"""Gives the processes of a test a wall clock of their own: Linux has no namespace for it.

Owns: a library that is loaded before all others (ld.so(8), LD_PRELOAD) and adds what is in the file
CLOCK_AHEAD_FILE, nanoseconds, to CLOCK_REALTIME. What waits until a time of that clock waits as
long as with the true one.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

import pytest

_SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const long long none;
static const volatile long long *ahead = &none;

__attribute__((constructor)) static void begin(void) {
  const char *path = getenv("CLOCK_AHEAD_FILE");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  void *found = MAP_FAILED;
  if (file >= 0) found = mmap(NULL, sizeof *ahead, PROT_READ, MAP_SHARED, file, 0);
  if (file >= 0) close(file);
  if (found != MAP_FAILED) ahead = found;
}

static void add(struct timespec *at, long long ns) {
  long long sum = at->tv_sec * 1000000000LL + at->tv_nsec + ns;
  at->tv_sec = sum / 1000000000LL;
  at->tv_nsec = sum % 1000000000LL;
}

int clock_gettime(clockid_t id, struct timespec *at) {
  int error = syscall(SYS_clock_gettime, id, at);
  if (!error && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) add(at, *ahead);
  return error;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
  struct timespec now;
  (void)zone;
  clock_gettime(CLOCK_REALTIME, &now);
  at->tv_sec = now.tv_sec;
  at->tv_usec = now.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *at) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (at) *at = now.tv_sec;
  return now.tv_sec;
}

/* Until a time of the monotonic clock, which is small, or of the other one. */
static struct timespec kernel(const struct timespec *until) {
  struct timespec at = *until;
  if (at.tv_sec > 1000000000) add(&at, -*ahead);
  return at;
}

int pthread_cond_timedwait(pthread_cond_t *restrict cond, pthread_mutex_t *restrict mutex,
                           const struct timespec *restrict until) {
  static int (*next)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
  struct timespec at = kernel(until);
  if (!next) next = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  return next(cond, mutex, &at);
}

int sem_timedwait(sem_t *restrict sem, const struct timespec *restrict until) {
  static int (*next)(sem_t *, const struct timespec *);
  struct timespec at = kernel(until);
  if (!next) next = dlsym(RTLD_NEXT, "sem_timedwait");
  return next(sem, &at);
}
"""


class OtherClock:
    """A clock for processes that are started with `variables`, and for their children.

    Skips the test where there is no compiler.

    Args:
        directory: to build in.
        ahead_s: of the true clock, seconds; negative is behind.
    """

    def __init__(self, directory: Path, ahead_s: float = 0.0) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            pytest.skip("a clock of its own needs a C compiler: install gcc")
        directory.mkdir(exist_ok=True)
        source, library = directory / "other_clock.c", directory / "other_clock.so"
        source.write_text(_SOURCE)
        subprocess.run(
            [compiler, "-shared", "-fPIC", "-O2", "-o", str(library), str(source), "-ldl"],
            check=True,
        )
        self._ahead = directory / "ahead"
        self._ahead.write_bytes(bytes(8))
        self.set(ahead_s)
        self.variables = {"LD_PRELOAD": str(library), "CLOCK_AHEAD_FILE": str(self._ahead)}

    def set(self, ahead_s: float) -> None:
        """Set it; at once, also for processes that run."""
        with self._ahead.open("r+b", buffering=0) as file:
            file.write(struct.pack("q", round(ahead_s * 1e9)))
