# The classes of wire.pyx as other compiled modules call them, without Python in between.
from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t, uint64_t

cdef enum:
    MAX_READ = 4096             # bytes a tick takes from a port
    MAX_FRAME = 1024
    MAX_FIELDS = 64
    MAX_MESSAGE = 64            # the longest Lawicel message has 30 bytes
    MAX_FRAMES = 1024           # of a read: the shortest Lawicel frame has 6 bytes
    MAX_QUEUED = 32             # frames of one send
    MAX_ECHOES = 256            # own frames that may still come back from an adapter
    MAX_PENDING = 4096  # unsent bytes of a line that takes none; with more, it counts as lost
    EXTENDED_FLAG = 1 << 31      # of a can_id: 29 bits (as in the kernel's struct can_frame)

cdef struct FieldPlace:
    int kind, at, size, big          # kind: place in _KINDS; bytes of the payload
    int low, bits, signed            # of a bit field; bits 0: all
    int sign                         # field with the sign, -1 for none
    uint64_t sign_mask, minus

cdef class Checksum:
    cdef readonly int width, size
    cdef int _kind
    cdef bint _reflected, _negated
    cdef uint64_t _mask, _init, _xor_out
    cdef uint64_t[256] _table

    cdef uint64_t over(self, const uint8_t *data, int size) noexcept nogil

cdef class Framer:
    cdef readonly object spec
    cdef readonly long frames, bad, skipped, lost, others, quiet_bytes, quiet_sums, quiet_lengths
    cdef readonly int size
    cdef Checksum _checksum
    cdef uint8_t[MAX_READ + MAX_FRAME] _buffer
    cdef uint8_t[MAX_FRAME] _newest
    cdef uint8_t[8] _sync, _tail
    cdef int _length, _sync_size, _tail_size, _head, _payload_size, _has_length, _crc_size, _crc_from, _crc_big
    cdef int _sequence, _known, _constants
    cdef int[MAX_FIELDS] _constant_field
    cdef double[MAX_FIELDS] _constant
    cdef FieldPlace[MAX_FIELDS] _field
    cdef uint64_t _modulus_mask

    cpdef int read(self, int fd) except -1
    cdef bint _is_whole(self, const uint8_t *frame) noexcept
    cdef int _scan(self) noexcept
    cdef uint64_t _raw(self, const uint8_t *payload, int field) noexcept
    cpdef uint64_t whole(self, int field) noexcept
    cpdef double number(self, int field) noexcept
    cdef double _number_in(self, const uint8_t *payload, int field) noexcept
    cpdef void drop(self) noexcept

cpdef bint wait_readable(int fd, int64_t until_ns) except -1

cpdef bytes encode_slcan(uint32_t can_id, bytes data)

cdef struct Frame:
    uint32_t can_id             # with EXTENDED_FLAG where it has 29 bits
    int size
    uint64_t data               # its bytes, the first one lowest

cdef class SlcanParser:
    cdef public long bad, refused, ignored
    cdef Frame[MAX_FRAMES] _frames
    cdef int _count
    cdef uint8_t[MAX_MESSAGE] _rest
    cdef int _length

    cpdef list feed(self, const uint8_t[::1] data)
    cdef void _feed(self, const uint8_t *data, int size) noexcept
    cdef void _take(self) noexcept

cdef class CanPort:
    cdef Frame *_in
    cdef int _count, _queued
    cdef Frame[MAX_QUEUED] _out
    cdef Frame[MAX_FRAMES] _own
    cdef Frame[MAX_ECHOES] _sent
    cdef long _sent_count, _echoed
    cdef bint _drops

    cdef void _note_sent(self) noexcept
    cdef bint _is_echo(self, const Frame *frame) noexcept

    cpdef int take(self) except -1
    cpdef int flush(self) except -1
    cpdef bint deliver(self, uint32_t can_id, bytes data) except -1
    cpdef int queue(self, uint32_t can_id, uint64_t data, int size) except -1
    cpdef uint32_t can_id(self, int k) noexcept
    cpdef int size(self, int k) noexcept
    cpdef uint64_t data(self, int k) noexcept

cdef class SlcanLine(CanPort):
    cdef int fd
    cdef readonly SlcanParser parser
    cdef char[8192] _unsent
    cdef int _unsent_size

cpdef long long nearest(double value) noexcept

cdef class Channels:
    cdef readonly int[::1] roles
    cdef double[::1] scale, offset, low, high, value, time_s
    cdef uint8_t[::1] fresh, status
    cdef object _sample

    cpdef bint put(self, object sample, int channel, double raw, double time_s) except -1

cdef class Ages:
    cdef double[::1] time_s, limit_s
    cdef uint8_t[::1] fresh, status

    cpdef void begin(self) noexcept
    cpdef void judge(self, double now_s) noexcept
