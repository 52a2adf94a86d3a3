/* Lets the wall clock of the processes that preload this differ from the machine's, at any moment.

   WALL_CLOCK names a file of eight bytes: how many nanoseconds CLOCK_REALTIME is ahead, which may
   change while they run. Clocks that only go forward are as they are. A wait until a wall clock's
   time ends when that clock says so, as in Linux, where setting it moves such waits. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <poll.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define SECOND 1000000000LL
#define SLICE (SECOND / 10) /* how soon a wait notices that the clock was set */
#define WALL_S 1000000000LL /* nobody is up for thirty years: a later time is a wall clock's */

static const volatile int64_t zero, *ahead = &zero;
static int (*clock_of)(clockid_t, struct timespec *);
static int (*condition_of)(pthread_cond_t *, pthread_mutex_t *, clockid_t, const struct timespec *);
static int (*signal_of)(pthread_cond_t *);
static int (*broadcast_of)(pthread_cond_t *);
static int (*semaphore_of)(sem_t *, clockid_t, const struct timespec *);
static int (*mutex_of)(pthread_mutex_t *, clockid_t, const struct timespec *);
static int (*timer_of)(int, int, const struct itimerspec *, struct itimerspec *);
static ssize_t (*read_of)(int, void *, size_t);
static int (*poll_of)(struct pollfd *, nfds_t, int);
static int (*sleep_of)(clockid_t, int, const struct timespec *, struct timespec *);

/* x86_64 has an older one, too, for other conditions. */
static void *newest(const char *name) {
  void *found = dlvsym(RTLD_NEXT, name, "GLIBC_2.3.2");
  return found ? found : dlsym(RTLD_NEXT, name);
}

__attribute__((constructor)) static void begin(void) {
  const char *path = getenv("WALL_CLOCK");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file >= 0) {
    void *found = mmap(NULL, sizeof *ahead, PROT_READ, MAP_SHARED, file, 0);
    if (found != MAP_FAILED) ahead = found;
    close(file);
  }
  signal_of = newest("pthread_cond_signal");
  broadcast_of = newest("pthread_cond_broadcast");
  condition_of = dlsym(RTLD_NEXT, "pthread_cond_clockwait");
  semaphore_of = dlsym(RTLD_NEXT, "sem_clockwait");
  mutex_of = dlsym(RTLD_NEXT, "pthread_mutex_clocklock");
  timer_of = dlsym(RTLD_NEXT, "timerfd_settime");
  read_of = dlsym(RTLD_NEXT, "read");
  poll_of = dlsym(RTLD_NEXT, "poll");
  sleep_of = dlsym(RTLD_NEXT, "clock_nanosleep");
  clock_of = dlsym(RTLD_NEXT, "clock_gettime");
}

static int64_t nanoseconds(const struct timespec *at) { return at->tv_sec * SECOND + at->tv_nsec; }

static struct timespec timespec_of(int64_t at) {
  struct timespec result = {at / SECOND, at % SECOND};
  return result;
}

static int64_t now_of(clockid_t clock) {
  struct timespec now;
  if (clock_of) clock_of(clock, &now);
  else syscall(SYS_clock_gettime, clock, &now);
  return nanoseconds(&now);
}

static int64_t wall(void) { return now_of(CLOCK_REALTIME) + *ahead; }

/* Return until when to wait, by CLOCK_MONOTONIC; `due`: the wait is over then. */
static struct timespec until(const struct timespec *at, int *due) {
  int64_t left = nanoseconds(at) - wall();
  *due = left <= SLICE;
  return timespec_of(now_of(CLOCK_MONOTONIC) + (left < 0 ? 0 : *due ? left : SLICE));
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  int result = clock_of ? clock_of(clock, now) : (int)syscall(SYS_clock_gettime, clock, now);
  if (!result && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
    *now = timespec_of(nanoseconds(now) + *ahead);
  return result;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
  int64_t at = wall();
  (void)zone;
  now->tv_sec = at / SECOND, now->tv_usec = at % SECOND / 1000;
  return 0;
}

time_t time(time_t *now) {
  time_t at = wall() / SECOND;
  if (now) *now = at;
  return at;
}

int timespec_get(struct timespec *now, int base) {
  return base == TIME_UTC && !clock_gettime(CLOCK_REALTIME, now) ? base : 0;
}

/* Who waits in slices misses a signal between two of them, and looks here whether there was one. */
static unsigned *signals_of(const pthread_cond_t *condition) {
  static unsigned signals[4096];
  return &signals[((uintptr_t)condition >> 3) % 4096];
}

static unsigned signalled(const pthread_cond_t *condition) {
  return __atomic_load_n(signals_of(condition), __ATOMIC_SEQ_CST);
}

int pthread_cond_signal(pthread_cond_t *condition) {
  __atomic_add_fetch(signals_of(condition), 1, __ATOMIC_SEQ_CST);
  return signal_of(condition);
}

int pthread_cond_broadcast(pthread_cond_t *condition) {
  __atomic_add_fetch(signals_of(condition), 1, __ATOMIC_SEQ_CST);
  return broadcast_of(condition);
}

int pthread_cond_clockwait(pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock,
                           const struct timespec *at) {
  int due, result;
  if (clock != CLOCK_REALTIME) return condition_of(condition, mutex, clock, at);
  unsigned before = signalled(condition);
  do {
    struct timespec end = until(at, &due);
    result = condition_of(condition, mutex, CLOCK_MONOTONIC, &end);
  } while (result == ETIMEDOUT && !due && signalled(condition) == before);
  return result == ETIMEDOUT && !due ? 0 : result;
}

int pthread_cond_timedwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex,
                           const struct timespec *restrict at) {
  clockid_t clock = at->tv_sec < WALL_S ? CLOCK_MONOTONIC : CLOCK_REALTIME;
  return pthread_cond_clockwait(condition, mutex, clock, at);
}

int sem_clockwait(sem_t *semaphore, clockid_t clock, const struct timespec *at) {
  int due, result;
  if (clock != CLOCK_REALTIME) return semaphore_of(semaphore, clock, at);
  do {
    struct timespec end = until(at, &due);
    result = semaphore_of(semaphore, CLOCK_MONOTONIC, &end);
  } while (result && errno == ETIMEDOUT && !due);
  return result;
}

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict at) {
  return sem_clockwait(semaphore, CLOCK_REALTIME, at);
}

int pthread_mutex_clocklock(pthread_mutex_t *mutex, clockid_t clock, const struct timespec *at) {
  int due, result;
  if (clock != CLOCK_REALTIME) return mutex_of(mutex, clock, at);
  do {
    struct timespec end = until(at, &due);
    result = mutex_of(mutex, CLOCK_MONOTONIC, &end);
  } while (result == ETIMEDOUT && !due);
  return result;
}

int pthread_mutex_timedlock(pthread_mutex_t *restrict mutex, const struct timespec *restrict at) {
  return pthread_mutex_clocklock(mutex, CLOCK_REALTIME, at);
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *at, struct timespec *left) {
  int due, result;
  if (clock != CLOCK_REALTIME || !(flags & TIMER_ABSTIME)) return sleep_of(clock, flags, at, left);
  do {
    struct timespec end = until(at, &due);
    result = sleep_of(CLOCK_MONOTONIC, TIMER_ABSTIME, &end, NULL);
  } while (!result && !due);
  return result;
}

/* Who reads a timer that is cancelled when the clock is set: EXPECTS of it what the clock is ahead. */
static struct { int timer; int64_t expects; } watches[64];

static int watch_of(int timer) {
  for (int each = 0; each < 64; each++)
    if (watches[each].timer == timer + 1) return each;
  return -1;
}

int timerfd_settime(int timer, int flags, const struct itimerspec *when, struct itimerspec *old) {
  int found = watch_of(timer), cancels = flags & TFD_TIMER_CANCEL_ON_SET;
  if (found < 0 && cancels) found = watch_of(-1);
  if (found >= 0) watches[found].timer = cancels ? timer + 1 : 0, watches[found].expects = *ahead;
  return timer_of(timer, flags, when, old);
}

/* Note of FILES which are timers that were cancelled; return how many poll(2) did not count. */
static int cancelled(struct pollfd *files, nfds_t count) {
  int more = 0;
  for (nfds_t each = 0; each < count; each++) {
    int found = files[each].fd < 0 ? -1 : watch_of(files[each].fd);
    if (found < 0 || watches[found].expects == *ahead) continue;
    more += !files[each].revents;
    files[each].revents |= POLLIN;
  }
  return more;
}

int poll(struct pollfd *files, nfds_t count, int wait_ms) {
  int64_t end = now_of(CLOCK_MONOTONIC) + wait_ms * (SECOND / 1000), left;
  int slice = SLICE / 1000000, watched = 0, result;
  if (!poll_of) poll_of = dlsym(RTLD_NEXT, "poll");
  for (nfds_t each = 0; each < count; each++)
    watched += files[each].fd >= 0 && watch_of(files[each].fd) >= 0;
  if (!watched) return poll_of(files, count, wait_ms);
  do {
    left = wait_ms < 0 ? slice : (end - now_of(CLOCK_MONOTONIC)) / 1000000;
    result = poll_of(files, count, left < 0 ? 0 : left < slice ? (int)left : slice);
    if (result >= 0) result += cancelled(files, count);
  } while (!result && left > 0);
  return result;
}

ssize_t read(int file, void *data, size_t length) {
  int found = watch_of(file);
  struct pollfd readable = {.fd = file, .events = POLLIN};
  while (found >= 0 && watches[found].timer == file + 1 &&
         poll_of(&readable, 1, SLICE / 1000000) == 0)
    if (watches[found].expects != *ahead) {
      watches[found].expects = *ahead;
      errno = ECANCELED;
      return -1;
    }
  return read_of ? read_of(file, data, length) : syscall(SYS_read, file, data, length);
}
