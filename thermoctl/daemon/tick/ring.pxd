# The classes of ring.pyx as the tick calls them, without Python in between.
from libc.stdint cimport uint64_t, uint8_t

cdef class Ring:
    cdef uint64_t[::1] counter
    cdef double[:, ::1] rows
    cdef readonly int slots, columns

    cpdef void write(self, double[::1] row) noexcept

cdef class Mailbox:
    cdef uint64_t[::1] counters
    cdef double[:, ::1] slots

    cpdef bint waiting(self) noexcept

cdef class Histogram:
    cdef uint64_t[::1] counts
    cdef double[::1] largest

    cpdef void add(self, double microseconds) noexcept

cdef class Record:
    cdef double[::1] row, value, outputs
    cdef uint8_t[::1] fresh, status, delay
    cdef int head

    cpdef void fill(self) noexcept

cdef class Remarks:
    cdef double[::1] ages, verdicts, numbers
    cdef double[:, ::1] onsets
    cdef double[::1] times
    cdef uint64_t[::1] sequences
    cdef uint8_t[:, ::1] texts
    cdef uint64_t bits
    cdef double late_limit_s, late_at_s, late_s

    cpdef bint fill(self, double[::1] age, double[::1] verdict, uint64_t bits, uint64_t trips, double t_s, double tick, double dt_s, double code) noexcept
    cpdef put(self, int channel, double t_s, bytes text)
