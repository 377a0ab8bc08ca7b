# cython: language_level=3, cdivision=True
"""The clock of the loop: CLOCK_MONOTONIC in nanoseconds, and sleeping until a point of it.

Absolute clock_nanosleep keeps the phase however long a tick took. It was the best of the measured ways to
wait (`docs/explanation/why-cython.md`). The interpreter's lock is released meanwhile.
"""
from posix.time cimport CLOCK_MONOTONIC, CLOCK_REALTIME, clock_gettime, timespec

cdef extern from "<time.h>" nogil:
    enum: CLOCK_BOOTTIME
    int clock_nanosleep(int clock, int flags, const timespec *request, timespec *remain)
    enum: TIMER_ABSTIME


cdef inline int64_t _now() noexcept nogil:
    cdef timespec t
    clock_gettime(CLOCK_MONOTONIC, &t)
    return <int64_t>t.tv_sec * 1000000000 + t.tv_nsec


cpdef int64_t now_ns() noexcept:
    """Return CLOCK_MONOTONIC, ns: the clock of `time.monotonic()` and of every process of the daemon."""
    return _now()


cpdef double wall_s() noexcept:
    """Return the system's clock, CLOCK_REALTIME, s, as `time.time()`."""
    cdef timespec t
    clock_gettime(CLOCK_REALTIME, &t)
    return <double>t.tv_sec + t.tv_nsec * 1e-9


cpdef int64_t suspended_ns() noexcept:
    """Return the time that the machine was suspended since its start, ns: CLOCK_BOOTTIME - CLOCK_MONOTONIC.

    The two clocks are read some 100 ns apart, so a growth of that size is no suspend."""
    cdef timespec t
    clock_gettime(CLOCK_BOOTTIME, &t)
    return <int64_t>t.tv_sec * 1000000000 + t.tv_nsec - _now()


cpdef int64_t sleep_until(int64_t deadline_ns, int64_t spin_ns=0) noexcept:
    """Sleep until `deadline_ns`, busy-waiting for the last `spin_ns`; return the time after, ns.

    Returns early only after a signal, so that Python's handlers run.
    """
    cdef timespec t
    cdef int64_t until = deadline_ns - spin_ns, now
    with nogil:
        now = _now()
        if now < until:
            t.tv_sec = until // 1000000000
            t.tv_nsec = until % 1000000000
            if clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) != 0:
                deadline_ns = 0
        now = _now()
        while now < deadline_ns:
            now = _now()
    return now
