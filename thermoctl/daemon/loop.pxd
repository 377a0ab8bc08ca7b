# C types for loop.py, which is the tick; see there.
from thermoctl.control.law cimport Law

cdef class Rig:
    cdef public object backend, publish_row, mailbox, parameter_box, state_box, reading, row, record, wall_s
    cdef public Law law
    cdef public double start_s, value
    cdef public long long slips, generation, external, write_failed
    cdef public int command

    cpdef sample(self, double now_s)
    cpdef _obey(self, double kind, double value)
    cpdef actuate(self)
    cpdef publish(self, double now_s, double dt_s, double lateness_us, double busy_us)
    cpdef keep_state(self)
