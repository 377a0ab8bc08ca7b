# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Encode and decode the bytes of a tick: frames with a CRC, Lawicel CAN in ASCII, checked readings.

Compiled, because interpreted code is slow in a tick: it runs once a period, with cold caches.

A binary frame on the wire:

    sync (0..8 bytes) | length (uint8, optional) | payload | checksum (optional) | tail (0..8 bytes)

Framing resynchronises after garbage: a frame whose length or CRC is wrong is dropped by its first byte only.
The search continues at the next byte, so a true frame behind a false sync is never lost. Nothing here waits.
The buffers are bounded: a frame by its profile, a Lawicel message by 64 bytes.
"""
import errno
import os
import struct

from libc.errno cimport EAGAIN, EINTR, errno as c_errno
from libc.math cimport NAN, llrint
from libc.string cimport memcmp, memcpy, memmove
from posix.time cimport CLOCK_MONOTONIC, clock_gettime, timespec
from posix.unistd cimport read as c_read, write as c_write

from thermoctl_hal.base.checksum import algorithm
from thermoctl_hal.base.profile import FRAME_TYPES

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

cdef class Checksum:
    """A checksum of thermoctl_hal.base.checksum by its name. Raises ValueError for an unknown one."""

    def __init__(self, str name):
        cdef int byte, k
        cdef uint64_t crc, top
        found = algorithm(name)
        if found is None:
            raise ValueError(f"checksum '{name}' is unknown")
        self._kind = ("none", "sum", "xor", "crc").index(found.kind)
        self.width, self.size = found.width, found.width // 8
        self._mask = <uint64_t>((1 << found.width) - 1)
        self._init, self._xor_out = found.init & self._mask, found.xor_out
        self._reflected, self._negated = found.reflected, found.negated
        poly = int(f"{found.poly:0{found.width}b}"[::-1], 2) if found.reflected and found.width else found.poly
        if found.kind == "crc":
            if found.reflected:
                self._init = int(f"{found.init:0{found.width}b}"[::-1], 2)
            top = (<uint64_t>1) << (self.width - 1)
            for byte in range(256):
                crc = byte if found.reflected else <uint64_t>byte << (self.width - 8)
                for k in range(8):
                    if found.reflected:
                        crc = crc >> 1 ^ <uint64_t>poly if crc & 1 else crc >> 1
                    else:
                        crc = (crc << 1 ^ <uint64_t>poly if crc & top else crc << 1) & self._mask
                self._table[byte] = crc

    cdef uint64_t over(self, const uint8_t *data, int size) noexcept nogil:
        cdef uint64_t crc = self._init
        cdef int i
        if self._kind == 1:
            for i in range(size):
                crc += data[i]
            if self._negated:
                crc = 0 - crc
        elif self._kind == 2:
            for i in range(size):
                crc ^= data[i]
        elif self._reflected:
            for i in range(size):
                crc = crc >> 8 ^ self._table[(crc ^ data[i]) & 0xFF]
        elif self._kind == 3:
            for i in range(size):
                crc = crc << 8 ^ self._table[(crc >> (self.width - 8) ^ data[i]) & 0xFF]
        return (crc ^ self._xor_out) & self._mask

    def of(self, const uint8_t[::1] data) -> int:
        """Return the checksum of `data`."""
        return self.over(&data[0] if data.shape[0] else NULL, <int>data.shape[0])


cdef dict _CHECKSUMS = {}


def checksum(str name, data) -> int:
    """Return the checksum of `data` by its name. Raises ValueError for an unknown name."""
    found = _CHECKSUMS.get(name)
    if found is None:
        found = _CHECKSUMS[name] = Checksum(name)
    return found.of(data)


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


cdef uint64_t NOT_A_NUMBER = ~(<uint64_t>0)


cdef class Framer:
    """Find frames in a stream of bytes; `newest` holds the fields of the last good one, () before it.

    Counters: `frames`; `bad` (wrong length, checksum or tail); `skipped` (bytes outside frames); `lost` (gaps
    of the sequence counter). `others` counts good frames in which a constant field has another number. The
    `quiet_` counters restart at every good frame: bytes received, wrong checksums (`sums`) and wrong length
    bytes since then.

    spec: thermoctl_hal.base.profile.BinaryFrame. Raises ValueError for a frame that is too long.
    """

    def __init__(self, spec):
        self.spec = spec
        self._sync_size, self._has_length, self._tail_size = len(spec.sync), spec.has_length, len(spec.tail)
        memcpy(self._sync, <const char *><bytes>spec.sync, self._sync_size)
        memcpy(self._tail, <const char *><bytes>spec.tail, self._tail_size)
        self._head = self._sync_size + self._has_length
        self._payload_size = spec.payload_size
        self._checksum = Checksum(spec.crc)
        self._crc_size = self._checksum.size
        self._crc_from = {"frame": 0, "after-sync": self._sync_size, "payload": self._head}[spec.crc_over]
        self.size = self._head + self._payload_size + self._crc_size + self._tail_size
        names = spec.names
        if self.size > MAX_FRAME or len(names) > MAX_FIELDS:
            raise ValueError(f"a frame of {self.size} bytes and {len(names)} fields; at most {MAX_FRAME} and {MAX_FIELDS}")
        self._crc_big = spec.crc_endian == ">"
        at = 0
        for i, (name, kind) in enumerate(spec.fields):
            what, size = FRAME_TYPES[kind]
            self._field[i] = FieldPlace(
                _KINDS.index(what), at, size, (spec.endian == ">") != (name in spec.other_endian), 0, 0, 0, -1, 0, 0)
            at += size
        for i, b in enumerate(spec.bits, len(spec.fields)):
            self._field[i] = self._field[names.index(b.of)]
            self._field[i].low, self._field[i].bits, self._field[i].signed = b.low, b.count, b.signed
        for name, test in spec.signs.items():
            i = names.index(name)
            self._field[i].sign, self._field[i].sign_mask = names.index(test.field), test.mask
            self._field[i].minus = test.value
        self._constants = 0
        for name, value in spec.constants.items():
            self._constant_field[self._constants], self._constant[self._constants] = names.index(name), value
            self._constants += 1
        self._sequence = names.index(spec.sequence) if spec.sequence else -1
        self._modulus_mask = ~(<uint64_t>0)
        if self._sequence >= 0:
            bits = self._field[self._sequence].bits or 8 * self._field[self._sequence].size
            self._modulus_mask = <uint64_t>((1 << bits) - 1)

    @property
    def modulus(self) -> int:
        """Return the number of values of the sequence counter."""
        return int(self._modulus_mask) + 1

    @property
    def newest(self) -> tuple:
        if not self._known:
            return ()
        found = []
        for i, (_, kind) in enumerate(self.spec.fields):
            what, size = FRAME_TYPES[kind]
            bits = self.whole(i)
            if what == "int" and bits >> (8 * size - 1):
                bits -= 1 << 8 * size
            found.append(self.number(i) if what == "float" or self._field[i].sign >= 0 else bits)
        return tuple(found)

    @property
    def pending(self) -> int:
        """Count the bytes of an incomplete frame."""
        return self._length

    def encode(self, *values) -> bytes:
        """Return a frame with these field values, one for each field (bit fields are part of theirs)."""
        payload = b""
        for value, (name, kind) in zip(values, self.spec.fields, strict=True):
            other = name in self.spec.other_endian
            payload += _packed(value, kind, (self.spec.endian == ">") != other)
        body = self.spec.sync + (bytes([self._payload_size]) if self._has_length else b"") + payload
        order = "big" if self._crc_big else "little"
        return body + self._checksum.of(body[self._crc_from:]).to_bytes(self._crc_size, order) + self.spec.tail

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

    cdef bint _is_whole(self, const uint8_t *frame) noexcept:
        """Whether the checksum and the tail of a frame are right."""
        cdef int i, at = self._head + self._payload_size
        cdef uint64_t found = 0
        if memcmp(frame + at + self._crc_size, self._tail, self._tail_size) != 0:
            return False
        for i in range(self._crc_size):
            found = found << 8 | frame[at + (i if self._crc_big else self._crc_size - 1 - i)]
        return self._crc_size == 0 or self._checksum.over(frame + self._crc_from, at - self._crc_from) == found

    cdef int _scan(self) noexcept:
        cdef uint8_t *buffer = self._buffer
        cdef int at = 0, start, end, n = self._length, good = 0, found, whole_length, k
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
                found = self._is_whole(buffer + at)
            if not found:
                self.bad += 1
                self.quiet_lengths += not whole_length
                self.quiet_sums += whole_length
                self.skipped += 1
                at += 1
                continue
            for k in range(self._constants):
                if self._number_in(buffer + at + self._head, self._constant_field[k]) != self._constant[k]:
                    break
            else:
                before = self.whole(self._sequence) if self._sequence >= 0 else 0
                memcpy(self._newest, buffer + at + self._head, self._payload_size)
                if self._sequence >= 0 and self._known:
                    self.lost += <long>((self.whole(self._sequence) - before - 1) & self._modulus_mask)
                self._known = 1
                self.quiet_bytes = self.quiet_sums = self.quiet_lengths = 0
                good += 1
                at = end
                continue
            self.others += 1
            at = end
        memmove(buffer, buffer + at, n - at)
        self._length = n - at
        self.frames += good
        return good

    cdef uint64_t _raw(self, const uint8_t *payload, int field) noexcept:
        """The whole number in a field; for digits and BCD the number that they spell, or NOT_A_NUMBER."""
        cdef FieldPlace *f = &self._field[field]
        cdef const uint8_t *p = payload + f.at
        cdef uint64_t value = 0
        cdef int i, digit, byte, ten = 16 if f.kind == 4 else 10
        for i in range(f.size):
            byte = p[i if f.big or f.kind > 3 else f.size - 1 - i]
            if f.kind == 3:                                  # BCD
                if byte >> 4 > 9 or byte & 15 > 9:
                    return NOT_A_NUMBER
                value = value * 100 + (byte >> 4) * 10 + (byte & 15)
            elif f.kind > 3:                                 # hexadecimal, decimal characters
                digit = _nibble(<uint8_t>byte)
                if byte == 32 and value == 0:
                    digit = 0
                if not 0 <= digit < ten:
                    return NOT_A_NUMBER
                value = value * ten + digit
            else:
                value = value << 8 | <uint64_t>byte
        if f.bits:
            value = value >> f.low
            if f.bits < 64:
                value &= ((<uint64_t>1) << f.bits) - 1
        return value

    cpdef uint64_t whole(self, int field) noexcept:
        """Return the bits of a field of the newest frame (sequence counters, status flags)."""
        return self._raw(self._newest, field)

    cpdef double number(self, int field) noexcept:
        """Return a field of the newest frame as a number, NaN where its characters are no number."""
        return self._number_in(self._newest, field)

    cdef double _number_in(self, const uint8_t *payload, int field) noexcept:
        cdef FieldPlace *f = &self._field[field]
        cdef uint64_t bits = self._raw(payload, field)
        cdef uint32_t half = <uint32_t>bits
        cdef int width = f.bits if f.bits else 8 * f.size
        cdef float single
        cdef double value
        if f.kind > 2 and bits == NOT_A_NUMBER:
            return NAN
        if f.kind == 2 and f.bits == 0:
            if f.size == 4:
                memcpy(&single, &half, 4)
                value = single
            else:
                memcpy(&value, &bits, 8)
        elif f.signed if f.bits else f.kind == 1:
            value = <double>(<int64_t>(bits << (64 - width)) >> (64 - width))
        else:
            value = <double>bits
        if f.sign >= 0 and self._raw(payload, f.sign) & f.sign_mask == f.minus:
            value = -value
        return value

    def reset(self) -> None:
        """Drop an incomplete frame and the sequence (after a reconnection)."""
        self._length = self._known = 0
        self.quiet_bytes = self.quiet_sums = self.quiet_lengths = 0

    cpdef void drop(self) noexcept:
        """Drop an incomplete frame (before a new request)."""
        self._length = 0


cdef tuple _KINDS = ("uint", "int", "float", "bcd", "hex", "digits", "skip")


def _packed(value, str kind, bint big) -> bytes:
    """Return a number as the bytes of a frame's field."""
    what, size = FRAME_TYPES[kind]
    if what == "float":
        return struct.pack((">" if big else "<") + ("f" if size == 4 else "d"), value)
    if what in ("hex", "digits"):
        return (f"{int(value):0{size}X}" if what == "hex" else f"{int(value):0{size}d}").encode()
    if what == "bcd":
        value = int(str(int(value)), 16)
    return int(value).to_bytes(size, "big" if big else "little", signed=what == "int")


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
        if self._is_echo(&self._own[self._count]):
            return False
        self._count += 1
        return True

    def drop_echoes(self) -> None:
        """Drop frames that the adapter hands back (CiA 402: no drive answers with the frame that it took)."""
        self._drops = True

    cdef void _note_sent(self) noexcept:
        """Remember the queued frames, and empty the queue."""
        cdef int k
        for k in range(self._queued):
            self._sent[self._sent_count % MAX_ECHOES] = self._out[k]
            self._sent_count += 1
        self._queued = 0

    cdef bint _is_echo(self, const Frame *frame) noexcept:
        """Return whether a frame is one that we sent and the adapter hands back; any other is of the bus.

        An adapter hands back all frames or none, in order. If the first frame sent does not come back,
        none is an echo: a heartbeat of another master equals ours."""
        cdef long k, first = self._echoed
        cdef long end = self._sent_count if first else min(self._sent_count, 1)
        cdef Frame *sent
        if not self._drops:
            return False
        if self._sent_count > first + MAX_ECHOES:
            if not first:
                return False
            first = self._sent_count - MAX_ECHOES
        for k in range(first, end):
            sent = &self._sent[k % MAX_ECHOES]
            if sent.can_id == frame.can_id and sent.size == frame.size and sent.data == frame.data:
                self._echoed = k + 1
                return True
        return False

    def begin(self) -> None:
        """Forget the received frames (for subclasses in Python)."""
        self._count = 0

    def queued(self) -> list:
        """Return the queued frames, (id, data), and empty the queue (for subclasses in Python)."""
        found = [_pair(&self._out[k]) for k in range(self._queued)]
        self._note_sent()
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

    def long_frames(self) -> list:
        """Return the CAN FD frames that have arrived, (id, data), and forget them."""
        return []

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
        cdef int k, kept = 0, got = _read(self.fd, data, MAX_READ)
        self.parser._count = 0
        self.parser._feed(data, got)
        for k in range(self.parser._count):
            if not self._is_echo(&self.parser._frames[k]):
                self.parser._frames[kept] = self.parser._frames[k]
                kept += 1
        self.parser._count = kept
        return kept

    cpdef int flush(self) except -1:
        cdef int k, done
        for k in range(self._queued):
            self._unsent_size += _encode(self._unsent + self._unsent_size, self._out[k].can_id,
                                         <const uint8_t *>&self._out[k].data, self._out[k].size)
        self._note_sent()
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
