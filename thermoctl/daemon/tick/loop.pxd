# C types for loop.py, which is the tick; see there.
cimport cython
from libc.stdint cimport uint8_t
from thermoctl_hal.rig.devices cimport DevicesBackend
from thermoctl.control.law cimport Law
from thermoctl.daemon.tick.clock cimport now_ns, sleep_until, suspended_ns, wall_s
from thermoctl.daemon.tick.ring cimport Histogram, Mailbox, Record, Remarks, Ring

cdef unsigned long long _OTHER_AXIS, _OWN_FAULTS
cdef int _FAULT, _STATE_EVERY, _COUNTERS_AT, _SUSPEND_EVERY, _SUSPEND_NS, _THERMAL, _LATEST, _OFF, _STATE, _CODE, _ABSENT
cdef double _DELAY_S

cdef class Axis:
    cdef public object backend, publish_row, parameter_box, state_box, reading, row, wall_s, suspended_ns, channels
    cdef int _n
    cdef public Record record
    cdef public Remarks remarks
    cdef public list said, guards
    cdef unsigned char[::1] _status
    cdef public Mailbox mailbox
    cdef public Law law
    cdef public double start_s, value, busy_us
    cdef public long long slips, generation, external, write_failed
    cdef public int command
    cdef double[::1] _head, _time_s
    cdef uint8_t[::1] _fresh, _delay

    @cython.locals(begin=cython.longlong, end=cython.longlong)
    cpdef tick(self, double now_s, double dt_s, double lateness_us=*, clock_ns=*)
    @cython.locals(devices=DevicesBackend, other=Axis, c=cython.int, age=cython.double)
    cpdef sample(self, double now_s)
    cpdef bint trips_others(self)
    cpdef _obey(self, double kind, double value)
    @cython.locals(devices=DevicesBackend)
    cpdef actuate(self)
    @cython.locals(law=Law, head='double[::1]', ring=Ring)
    cpdef publish(self, double now_s, double dt_s, double lateness_us)
    @cython.locals(law=Law, head='double[::1]', off=cython.bint, new=cython.bint, bits=cython.ulonglong, trips=cython.ulonglong, c=cython.int)
    cpdef remark(self, double t_s, double dt_s)
    @cython.locals(verdict=cython.double)
    cdef _say(self, int c, double t_s)
    cpdef keep_state(self)

@cython.locals(lateness=Histogram, busy=Histogram)
cdef _count(Axis rig, shared, double lateness_us, long long warm_up_ticks)

@cython.locals(paced=cython.bint, counted=cython.bint, period_ns=cython.longlong, spin_ns=cython.longlong,
               before=cython.longlong, now=cython.longlong, deadline=cython.longlong, slept=cython.longlong,
               slept_before=cython.longlong, gap_ns=cython.longlong, late_ns=cython.longlong, skipped=cython.longlong,
               lateness_us=cython.double, now_s=cython.double, dt_s=cython.double, other=Axis)
cpdef run_loop(settings, shared, Axis rig, stopping, long long warm_up_ticks=*, further=*)
