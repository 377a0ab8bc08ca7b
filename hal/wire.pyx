# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Encode and decode the bytes of a tick: frames with a CRC, Lawicel CAN in ASCII, checked readings.

Compiled, because interpreted code is slow in a tick: it runs once a period, with cold caches.

A binary frame on the wire:

    sync (1..8 bytes) | length (uint8, optional) | payload | CRC-16 over all that follows sync (optional)

Framing resynchronises after garbage: a frame whose length or CRC is wrong is dropped by its first byte only.
The search continues at the next byte, so a true frame behind a false sync is never lost. Nothing here waits.
The buffers are bounded: a frame by its profile, a Lawicel message by 64 bytes.
"""
import errno
import os
import struct

from libc.errno cimport EAGAIN, EINTR, errno as c_errno
from libc.math cimport llrint
from libc.stdint cimport int8_t, int16_t, int32_t
from libc.string cimport memcmp, memcpy, memmove
from posix.time cimport CLOCK_MONOTONIC, clock_gettime, timespec
from posix.unistd cimport read as c_read, write as c_write

from hal.profile import CRCS, FIELD_TYPES

EXTENDED = 0x80000000
"""Bit 31 of an identifier: it has 29 bits. An 11-bit identifier of the same number is another one."""

cdef extern from "<sys/ioctl.h>" nogil:
    unsigned long FIONREAD
    int ioctl(int fd, unsigned long request, int *number)

cdef extern from "<poll.h>" nogil:
    cdef struct pollfd:
        int fd
        short events, revents
    int POLLIN
    int ppoll(pollfd *what, unsigned long count, const timespec *timeout, const void *mask)

cdef uint16_t[256] _CCITT, _MODBUS


cdef void _fill_tables() noexcept:
    cdef int byte, k
    cdef uint16_t crc
    for byte in range(256):
        crc = <uint16_t>(byte << 8)
        for k in range(8):
            crc = <uint16_t>((crc << 1) ^ 0x1021) if crc & 0x8000 else <uint16_t>(crc << 1)
        _CCITT[byte] = crc
        crc = <uint16_t>byte
        for k in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
        _MODBUS[byte] = crc


_fill_tables()


cdef uint16_t _crc16(int kind, const uint8_t *data, int size) noexcept nogil:
    cdef uint16_t crc = 0 if kind == 1 else 0xFFFF
    cdef int i
    if kind == 2:
        for i in range(size):
            crc = (crc >> 8) ^ _MODBUS[(crc ^ data[i]) & 0xFF]
    else:
        for i in range(size):
            crc = <uint16_t>(crc << 8) ^ _CCITT[(crc >> 8) ^ data[i]]
    return crc


def crc16(str kind, const uint8_t[::1] data) -> int:
    """CRC-16 of `data`. Check values of b'123456789': ccitt-false 0x29B1, xmodem 0x31C3, modbus 0x4B37."""
    return _crc16(CRCS.index(kind), &data[0] if data.shape[0] else NULL, <int>data.shape[0])


cpdef bint wait_readable(int fd, int64_t until_ns) except -1:
    """Wait until a descriptor is readable or CLOCK_MONOTONIC reaches `until_ns`; return whether it is
    readable.

    Returns False after a signal, so that Python's handlers run."""
    cdef timespec now, left
    cdef pollfd what
    cdef int64_t ns
    cdef int found
    what.fd, what.events, what.revents = fd, POLLIN, 0
    clock_gettime(CLOCK_MONOTONIC, &now)
    ns = max(<int64_t>0, until_ns - (<int64_t>now.tv_sec * 1000000000 + now.tv_nsec))
    left.tv_sec, left.tv_nsec = ns // 1000000000, ns % 1000000000
    with nogil:
        found = ppoll(&what, 1, &left, NULL)
    return found > 0


cdef int _read(int fd, uint8_t *to, int size) except -1:
    """Return the number of bytes read, 0 when none has arrived. Raises OSError when the other end is gone.

    FIONREAD is asked first: a read of an empty terminal waits for a kernel worker, even without blocking. On
    a busy machine that costs tens of milliseconds.
    """
    cdef int there = 1, got
    if ioctl(fd, FIONREAD, &there) == 0 and there == 0:
        return 0
    got = <int>c_read(fd, to, size)
    if got > 0:
        return got
    if got < 0 and (c_errno == EAGAIN or c_errno == EINTR):
        return 0
    if got == 0:
        raise OSError(errno.EIO, "the port was closed at the other end")
    raise OSError(c_errno, os.strerror(c_errno))


def read_available(int fd) -> bytes:
    """Return the bytes that have arrived, without waiting. Raises OSError when the other end is gone."""
    cdef uint8_t[MAX_READ] data
    cdef int got = _read(fd, data, MAX_READ)
    return data[:got]


cdef class Framer:
    """Find frames in a stream of bytes. `newest` is the payload of the last good frame, () before the first.

    Counters: `frames`; `bad` (wrong length or CRC); `skipped` (bytes outside frames); `lost` (gaps of the
    sequence counter). The `quiet_` counters restart at every good frame: bytes received, wrong CRCs (`sums`)
    and wrong length bytes since then.

    spec: hal.profile.BinaryFrame.
    """

    def __init__(self, spec):
        self.spec, self._payload = spec, spec.payload
        self._sync_size, self._has_length = len(spec.sync), spec.has_length
        memcpy(self._sync, <const char *><bytes>spec.sync, self._sync_size)
        self._head = self._sync_size + self._has_length
        self._payload_size = self._payload.size
        self._crc_size = 0 if spec.crc == "none" else 2
        self.size = self._head + self._payload_size + self._crc_size
        if self.size > MAX_FRAME or len(spec.fields) > MAX_FIELDS:
            raise ValueError(f"a frame of {self.size} bytes and {len(spec.fields)} fields; at most {MAX_FRAME} and {MAX_FIELDS}")
        self._crc_kind, self._crc_big = CRCS.index(spec.crc), spec.crc_endian == ">"
        self._big = spec.endian == ">"
        names = [n for n, _ in spec.fields]
        at = 0
        for i, (_, kind) in enumerate(spec.fields):
            self._type[i], self._offset[i] = ord(FIELD_TYPES[kind]), at
            at += struct.calcsize(FIELD_TYPES[kind])
        self._sequence = names.index(spec.sequence) if spec.sequence else -1
        bits = 8 * struct.calcsize(FIELD_TYPES[spec.fields[self._sequence][1]]) if spec.sequence else 64
        self._modulus_mask = <uint64_t>((1 << bits) - 1)

    @property
    def modulus(self) -> int:
        """Return the number of values of the sequence counter."""
        return int(self._modulus_mask) + 1

    @property
    def newest(self) -> tuple:
        return self._payload.unpack(bytes(self._newest[:self._payload_size])) if self._known else ()

    @property
    def pending(self) -> int:
        """Count the bytes of an incomplete frame."""
        return self._length

    def encode(self, *values) -> bytes:
        """Return a frame with these field values."""
        body = (bytes([self._payload_size]) if self._has_length else b"") + self._payload.pack(*values)
        if not self._crc_size:
            return self.spec.sync + body
        return self.spec.sync + body + crc16(self.spec.crc, body).to_bytes(2, "big" if self._crc_big else "little")

    def feed(self, const uint8_t[::1] data) -> int:
        """Take bytes; return the number of good frames that they completed."""
        cdef Py_ssize_t at = 0, part
        cdef int good = 0
        while at < data.shape[0]:
            part = min(<Py_ssize_t>MAX_READ, data.shape[0] - at)
            memcpy(self._buffer + self._length, &data[at], part)
            self._length += <int>part
            self.quiet_bytes += part
            good += self._scan()
            at += part
        return good

    cpdef int read(self, int fd) except -1:
        """Read a descriptor; return the number of good frames completed. Raises OSError when it is gone."""
        cdef int got = _read(fd, self._buffer + self._length, MAX_READ)
        if got == 0:
            return 0
        self._length += got
        self.quiet_bytes += got
        return self._scan()

    cdef int _scan(self) noexcept:
        cdef uint8_t *buffer = self._buffer
        cdef int at = 0, start, end, n = self._length, good = 0, found, whole_length
        cdef uint16_t crc
        cdef uint64_t before
        while at < n:
            start = at
            while start + self._sync_size <= n and memcmp(buffer + start, self._sync, self._sync_size) != 0:
                start += 1
            if start + self._sync_size > n:                  # the tail may be the beginning of a sync
                start = max(at, n - self._sync_size + 1)
                self.skipped += start - at
                at = start
                break
            self.skipped += start - at
            at = start
            whole_length = not self._has_length or n <= at + self._sync_size or buffer[at + self._sync_size] == self._payload_size
            found = whole_length
            if found:
                if n - at < self.size:
                    break
                end = at + self.size
                if self._crc_size:
                    crc = (<uint16_t>(buffer[end - 2] << 8) | buffer[end - 1] if self._crc_big
                           else <uint16_t>(buffer[end - 1] << 8) | buffer[end - 2])
                    found = _crc16(self._crc_kind, buffer + at + self._sync_size, self.size - self._sync_size - 2) == crc
            if not found:
                self.bad += 1
                self.quiet_lengths += not whole_length
                self.quiet_sums += whole_length
                self.skipped += 1
                at += 1
                continue
            if self._sequence >= 0:
                before = self.whole(self._sequence)
                memcpy(self._newest, buffer + at + self._head, self._payload_size)
                if self._known:
                    self.lost += <long>((self.whole(self._sequence) - before - 1) & self._modulus_mask)
            else:
                memcpy(self._newest, buffer + at + self._head, self._payload_size)
            self._known = 1
            self.quiet_bytes = self.quiet_sums = self.quiet_lengths = 0
            good += 1
            at = end
        memmove(buffer, buffer + at, n - at)
        self._length = n - at
        self.frames += good
        return good

    cdef uint64_t _bits(self, int field, int size) noexcept:
        cdef uint64_t value = 0
        cdef const uint8_t *p = self._newest + self._offset[field]
        cdef int i
        for i in range(size):
            value = value << 8 | p[i if self._big else size - 1 - i]
        return value

    cpdef uint64_t whole(self, int field) noexcept:
        """Return the bits of a field of the newest frame (sequence counters, status flags)."""
        cdef char t = self._type[field]
        return self._bits(field, 1 if t in (b'b', b'B') else 2 if t in (b'h', b'H') else 4 if t in (b'i', b'I', b'f') else 8)

    cpdef double number(self, int field) noexcept:
        """Return a field of the newest frame as a number."""
        cdef uint64_t bits = self.whole(field)
        cdef uint32_t half = <uint32_t>bits
        cdef float single
        cdef double double_
        cdef char t = self._type[field]
        if t == b'i':
            return <int32_t>half
        if t == b'h':
            return <int16_t>half
        if t == b'b':
            return <int8_t>half
        if t == b'q':
            return <double><int64_t>bits
        if t == b'f':
            memcpy(&single, &half, 4)
            return single
        if t == b'd':
            memcpy(&double_, &bits, 8)
            return double_
        return <double>bits

    def reset(self) -> None:
        """Drop an incomplete frame and the sequence (after a reconnection)."""
        self._length = self._known = 0
        self.quiet_bytes = self.quiet_sums = self.quiet_lengths = 0


cdef int _nibble(uint8_t c) noexcept nogil:
    if 48 <= c <= 57:
        return c - 48
    c |= 32
    return c - 87 if 97 <= c <= 102 else -1


cdef char *_DIGITS = b"0123456789ABCDEF"


cdef int _encode(char *out, uint32_t can_id, const uint8_t *data, int size) noexcept nogil:
    cdef int digits = 8 if can_id & EXTENDED_FLAG else 3, at = 1, i
    can_id &= 0x1FFFFFFF if digits == 8 else 0x7FF
    out[0] = b't' if digits == 3 else b'T'
    for i in range(digits):
        out[at] = _DIGITS[can_id >> (4 * (digits - 1 - i)) & 15]
        at += 1
    out[at] = <char>(48 + size)
    at += 1
    for i in range(size):
        out[at], out[at + 1] = _DIGITS[data[i] >> 4], _DIGITS[data[i] & 15]
        at += 2
    out[at] = b'\r'
    return at + 1


cdef uint64_t _whole(bytes data) except? 1:
    cdef uint64_t value = 0
    if len(data) > 8:
        raise ValueError(f"a CAN frame has at most 8 bytes, not {len(data)}")
    memcpy(&value, <const char *>data, len(data))
    return value


cpdef bytes encode_slcan(uint32_t can_id, bytes data):
    """Return a data frame in Lawicel ASCII: t iii l dd.. CR, or T iiiiiiii l dd.. CR for an id of 29 bits."""
    cdef char[MAX_MESSAGE] out
    cdef uint64_t value = _whole(data)
    return out[:_encode(out, can_id, <const uint8_t *>&value, <int>len(data))]


cdef class SlcanParser:
    """Find data frames in an adapter's bytes; the id of a 29-bit frame (T) has the bit EXTENDED.

    Acknowledgements (z, Z, CR) pass silently. `refused` counts BEL, by which the adapter refuses a command.
    `ignored` counts remote and CAN FD frames, `bad` invalid messages. Time stamps after the data are ignored.
    """

    @property
    def pending(self) -> int:
        """Count the bytes of an incomplete message."""
        return self._length

    cpdef list feed(self, const uint8_t[::1] data):
        """Return the frames that `data` completed, in order: (id, data)."""
        cdef Py_ssize_t at, part
        found = []
        for at in range(0, data.shape[0], MAX_READ):
            part = min(<Py_ssize_t>MAX_READ, data.shape[0] - at)
            self._count = 0
            self._feed(&data[at], <int>part)
            found += [_pair(&self._frames[k]) for k in range(self._count)]
        return found

    cdef void _feed(self, const uint8_t *data, int size) noexcept:
        cdef int i
        for i in range(size):
            if data[i] == b'\r':
                if self._length > 0:
                    self._take()
                self._length = 0
            elif data[i] == b'\a':
                self.refused += 1
            elif self._length == MAX_MESSAGE:               # longer than any message: drop it
                self._length = -1
                self.bad += 1
            elif self._length >= 0:
                self._rest[self._length] = data[i]
                self._length += 1

    cdef void _take(self) noexcept:
        cdef uint8_t *m = self._rest
        cdef int digits, size, i, high, low
        cdef uint32_t can_id = 0
        cdef uint64_t body = 0
        if m[0] != b't' and m[0] != b'T':
            # Remote frames; CAN FD as CANable 2 writes them.
            if m[0] in (b'r', b'R', b'd', b'D', b'b', b'B'):
                self.ignored += 1
            else:
                self.bad += not (m[0] == b'z' or m[0] == b'Z' or m[0] == b'F' or m[0] == b'V' or m[0] == b'N')
            return
        digits = 3 if m[0] == b't' else 8
        size = m[1 + digits] - 48 if self._length > 1 + digits else -1
        if not 0 <= size <= 8 or self._length < 2 + digits + 2 * size or self._count == MAX_FRAMES:
            self.bad += 1
            return
        for i in range(digits):
            high = _nibble(m[1 + i])
            if high < 0:
                self.bad += 1
                return
            can_id = can_id << 4 | <uint32_t>high
        if can_id > (0x7FF if digits == 3 else 0x1FFFFFFF):
            self.bad += 1
            return
        if digits == 8:
            can_id |= EXTENDED_FLAG
        for i in range(size):
            high, low = _nibble(m[2 + digits + 2 * i]), _nibble(m[3 + digits + 2 * i])
            if high < 0 or low < 0:
                self.bad += 1
                return
            body |= <uint64_t>(high << 4 | low) << 8 * i
        self._frames[self._count] = Frame(can_id, size, body)
        self._count += 1


cdef tuple _pair(Frame *frame):
    return frame.can_id, (<char *>&frame.data)[:frame.size]


cdef class CanPort:
    """A CAN bus that the tick uses without waiting. A frame's data is one whole number, first byte lowest.

    Subclasses implement `take` and `flush`. `take` receives frames for `can_id`, `size` and `data`; `flush`
    sends the queued frames. Both raise OSError when the bus is gone. `receive` and `send` do the same with
    bytes.
    """

    def __cinit__(self):
        self._in = self._own

    cpdef int take(self) except -1:
        """Receive the frames that have arrived; return how many. Raises OSError when the bus is gone."""
        raise NotImplementedError

    cpdef int flush(self) except -1:
        """Send the queued frames, without waiting. Raises OSError when the bus is gone or takes no frames."""
        raise NotImplementedError

    cpdef bint deliver(self, uint32_t can_id, bytes data) except -1:
        """Add a frame that has arrived since `begin` (for subclasses in Python).

        False when there is no room, or the frame has more than 8 bytes."""
        if self._count == MAX_FRAMES or len(data) > 8:
            return False
        self._own[self._count] = Frame(can_id, <int>len(data), _whole(data))
        self._count += 1
        return True

    def begin(self) -> None:
        """Forget the received frames (for subclasses in Python)."""
        self._count = 0

    def queued(self) -> list:
        """Return the queued frames, (id, data), and empty the queue (for subclasses in Python)."""
        found = [_pair(&self._out[k]) for k in range(self._queued)]
        self._queued = 0
        return found

    cpdef int queue(self, uint32_t can_id, uint64_t data, int size) except -1:
        """Add a frame for the next `flush`; at most MAX_QUEUED. Raises ValueError."""
        if self._queued == MAX_QUEUED or not 0 <= size <= 8:
            raise ValueError(f"{self._queued} frames wait, one of {size} bytes: at most {MAX_QUEUED}, of 8 bytes")
        self._out[self._queued] = Frame(can_id, size, data)
        self._queued += 1
        return 0

    cpdef uint32_t can_id(self, int k) noexcept:
        """Identifier of frame k of the last `take`, with the bit EXTENDED where it has 29 bits."""
        return self._in[k].can_id

    cpdef int size(self, int k) noexcept:
        """Bytes of frame k."""
        return self._in[k].size

    cpdef uint64_t data(self, int k) noexcept:
        """Data of frame k."""
        return self._in[k].data

    def send(self, *frames) -> None:
        """Send frames (id, data) without waiting. Raises OSError as `flush`."""
        for can_id, data in frames:
            self.queue(can_id, _whole(data), len(data))
        self.flush()

    def receive(self) -> list:
        """Return the frames that have arrived, (id, data). Raises OSError when the bus is gone."""
        return [_pair(&self._in[k]) for k in range(self.take())]


cdef class SlcanLine(CanPort):
    """Lawicel ASCII on an open descriptor; at most MAX_PENDING unsent bytes wait."""

    def __init__(self, int fd):
        self.fd = fd
        self.parser = SlcanParser()
        self._in = self.parser._frames

    cpdef int take(self) except -1:
        cdef uint8_t[MAX_READ] data
        cdef int got = _read(self.fd, data, MAX_READ)
        self.parser._count = 0
        self.parser._feed(data, got)
        return self.parser._count

    cpdef int flush(self) except -1:
        cdef int k, done
        for k in range(self._queued):
            self._unsent_size += _encode(self._unsent + self._unsent_size, self._out[k].can_id,
                                         <const uint8_t *>&self._out[k].data, self._out[k].size)
        self._queued = 0
        done = <int>c_write(self.fd, self._unsent, self._unsent_size)
        if done < 0:
            if c_errno != EAGAIN and c_errno != EINTR:
                self._unsent_size = 0
                raise OSError(c_errno, os.strerror(c_errno))
            done = 0
        self._unsent_size -= done
        if self._unsent_size > MAX_PENDING:
            self._unsent_size = 0
            raise OSError(errno.ENOBUFS, "the adapter takes no data")
        if done and self._unsent_size:
            memmove(self._unsent, self._unsent + done, self._unsent_size)
        return 0


cpdef long long nearest(double value) noexcept:
    """Return the nearest whole number, as `round`."""
    return llrint(value)


cdef class Channels:
    """The bound channels of one device: reading = raw * scale + offset, good inside low..high.

    roles, scale, offset, low, high: one number a channel, in order.
    """

    def __init__(self, int[::1] roles, double[::1] scale, double[::1] offset, double[::1] low, double[::1] high):
        self.roles, self.scale, self.offset, self.low, self.high = roles, scale, offset, low, high

    cpdef bint put(self, object sample, int channel, double raw, double time_s) except -1:
        """Store a raw reading of `channel` in a hal.backend.Sample; False, and nothing stored, when it is out
        of range."""
        cdef double value = raw * self.scale[channel] + self.offset[channel]
        cdef int role = self.roles[channel]
        if sample is not self._sample:
            self._sample, self.value, self.time_s = sample, sample.value, sample.time_s
            self.fresh, self.status = sample.fresh.view("u1"), sample.status
        if not (self.low[channel] <= value <= self.high[channel]) or value - value != 0.0:
            return False
        self.value[role], self.time_s[role], self.fresh[role], self.status[role] = value, time_s, 1, 0
        return True


cdef class Ages:
    """Finds the readings of a sample that are too old. limit_s: float64 over the roles."""

    def __init__(self, sample, double[::1] limit_s):
        self.time_s, self.fresh, self.status = sample.time_s, sample.fresh.view("u1"), sample.status
        self.limit_s = limit_s

    cpdef void begin(self) noexcept:
        """Start a tick: mark every reading as not fresh."""
        cdef Py_ssize_t k
        for k in range(self.fresh.shape[0]):
            self.fresh[k] = 0

    cpdef void judge(self, double now_s) noexcept:
        """Change OK to STALE where the newest reading is older than its limit; an ERROR stays one."""
        cdef Py_ssize_t k
        for k in range(self.time_s.shape[0]):
            if self.status[k] == 0 and now_s - self.time_s[k] > self.limit_s[k]:
                self.status[k] = 1
