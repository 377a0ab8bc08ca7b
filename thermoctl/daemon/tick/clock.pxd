# The functions of clock.pyx as the tick calls them, without Python in between.
from libc.stdint cimport int64_t

cpdef int64_t now_ns() noexcept
cpdef double wall_s() noexcept
cpdef int64_t suspended_ns() noexcept
cpdef int64_t sleep_until(int64_t deadline_ns, int64_t spin_ns=*) noexcept
