"""Gives the processes of a test a wall clock of their own: Linux has no namespace for it.

Owns: a library that is loaded before all others (ld.so(8), LD_PRELOAD) and adds CLOCK_AHEAD_NS to
CLOCK_REALTIME. What waits until a time of that clock waits as long as with the true one.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

_SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static long long ahead;

__attribute__((constructor)) static void begin(void) {
  const char *text = getenv("CLOCK_AHEAD_NS");
  ahead = text ? atoll(text) : 0;
}

static void add(struct timespec *at, long long ns) {
  long long sum = at->tv_sec * 1000000000LL + at->tv_nsec + ns;
  at->tv_sec = sum / 1000000000LL;
  at->tv_nsec = sum % 1000000000LL;
}

int clock_gettime(clockid_t id, struct timespec *at) {
  int error = syscall(SYS_clock_gettime, id, at);
  if (!error && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) add(at, ahead);
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
  if (at.tv_sec > 1000000000) add(&at, -ahead);
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


def other_clock(directory: Path, ahead_s: float) -> dict[str, str]:
    """Return what gives a process that is started with it, and its children, another clock.

    Skips the test where there is no compiler.

    Args:
        directory: to build in.
        ahead_s: of the true clock, seconds; negative is behind.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("a clock of its own needs a C compiler: install gcc")
    source, library = directory / "other_clock.c", directory / "other_clock.so"
    source.write_text(_SOURCE)
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O2", "-o", str(library), str(source), "-ldl"], check=True
    )
    return {"LD_PRELOAD": str(library), "CLOCK_AHEAD_NS": str(round(ahead_s * 1e9))}
