# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Structures in shared memory that the loop writes and others read; a reader never makes the loop wait.

- Ring: rows of float64, one a tick; the newest row is the last one. The writer fills a slot, then raises
  `head`. A reader copies rows and reads `head` again. Rows that may have been overwritten meanwhile are
  dropped and counted.
- Mailbox: (kind, value) commands from one producer to the loop, lock-free; refuses when full.
- Box: one vector with a sequence number (odd while written): parameters to the loop, the law's state from it.
- Histogram: counts of whole microseconds.
- Remarks: age and verdict of each reading, onset of each active fault, messages of the devices.
"""
from libc.stdint cimport uint64_t
from libc.string cimport memcpy

import numpy as np

from thermoctl.rig.channels import AT
from thermoctl.rig.signals import DELAYS_PER_WORD, FRESH_PER_WORD, OUTPUTS, STATUS_PER_WORD

# The air and the points have their delay recorded. All words hold at most 52 bits, exact in a float64.
cdef int FIRST_DELAYED = AT["air_c"], OUTPUTS_OF_EVERY_RIG = len(OUTPUTS)
cdef int FRESH_WORD = FRESH_PER_WORD, STATUS_WORD = STATUS_PER_WORD, DELAY_WORD = DELAYS_PER_WORD

cdef extern from *:
    """
    #include <stdint.h>
    static inline uint64_t load_acquire(uint64_t *p) { return __atomic_load_n(p, __ATOMIC_ACQUIRE); }
    static inline void store_release(uint64_t *p, uint64_t v) { __atomic_store_n(p, v, __ATOMIC_RELEASE); }
    static inline void fence(void) { __atomic_thread_fence(__ATOMIC_SEQ_CST); }
    """
    uint64_t load_acquire(uint64_t *p) noexcept nogil
    void store_release(uint64_t *p, uint64_t v) noexcept nogil
    void fence() noexcept nogil


cdef class Ring:
    """`counter` uint64 (1,), `rows` float64 (slots, columns), both in shared memory."""

    def __init__(self, uint64_t[::1] counter, double[:, ::1] rows):
        self.counter, self.rows = counter, rows
        self.slots, self.columns = rows.shape[0], rows.shape[1]

    @property
    def head(self) -> int:
        """Rows written since the start."""
        return load_acquire(&self.counter[0])

    cpdef void write(self, double[::1] row) noexcept:
        """Append one row (by the loop only)."""
        cdef uint64_t head = self.counter[0]
        fence()
        memcpy(&self.rows[head % self.slots, 0], &row[0], self.columns * sizeof(double))
        store_release(&self.counter[0], head + 1)

    def read(self, uint64_t position, int limit=1 << 30):
        """Return (rows (n, columns) from `position` on, next position, rows lost before them)."""
        cdef uint64_t head = load_acquire(&self.counter[0]), first, k, after, keep, lost = 0
        cdef double[:, ::1] out
        if position > head:
            position = head                      # the loop was restarted on a fresh ring
        first = position
        if head > <uint64_t>self.slots - 1 and first < head - (self.slots - 1):
            first = head - (self.slots - 1)
        if head - first > <uint64_t>limit:
            head = first + limit
        array = np.empty((head - first, self.columns))
        out = array
        for k in range(first, head):
            memcpy(&out[k - first, 0], &self.rows[k % self.slots, 0], self.columns * sizeof(double))
        fence()
        after = load_acquire(&self.counter[0])
        keep = first
        if after > <uint64_t>self.slots - 1 and first < after - (self.slots - 1):
            keep = min(after - (self.slots - 1), head)
        return array[keep - first:], head, keep - position

    def newest(self):
        """Return a copy of the newest row, or None before the first."""
        cdef uint64_t head
        while True:
            head = load_acquire(&self.counter[0])
            if head == 0:
                return None
            rows, _, lost = self.read(head - 1, 1)
            if len(rows):
                return rows[0]


cdef class Mailbox:
    """`counters` uint64 (2,): pushed, taken; `slots` float64 (n, 2)."""

    def __init__(self, uint64_t[::1] counters, double[:, ::1] slots):
        self.counters, self.slots = counters, slots

    def push(self, double kind, double value=0.0) -> bool:
        """Add a command (one producer only); return False when the box is full."""
        cdef uint64_t pushed = self.counters[0]
        if pushed - load_acquire(&self.counters[1]) >= <uint64_t>self.slots.shape[0]:
            return False
        self.slots[pushed % self.slots.shape[0], 0] = kind
        self.slots[pushed % self.slots.shape[0], 1] = value
        store_release(&self.counters[0], pushed + 1)
        return True

    @property
    def taken(self) -> int:
        return load_acquire(&self.counters[1])

    @property
    def pushed(self) -> int:
        return load_acquire(&self.counters[0])

    cpdef bint waiting(self) noexcept:
        """Return whether there is a command to take."""
        return self.counters[1] != load_acquire(&self.counters[0])

    def take(self):
        """Take the oldest command as (kind, value), or None (by the loop only)."""
        cdef uint64_t taken = self.counters[1]
        if taken == load_acquire(&self.counters[0]):
            return None
        kind, value = self.slots[taken % self.slots.shape[0], 0], self.slots[taken % self.slots.shape[0], 1]
        store_release(&self.counters[1], taken + 1)
        return kind, value


cdef class Box:
    """One vector, replaced whole. `counter`: uint64 (1,); `vector`: float64 (n,), its length first."""
    cdef uint64_t[::1] counter
    cdef double[::1] vector

    def __init__(self, uint64_t[::1] counter, double[::1] vector):
        self.counter, self.vector = counter, vector

    def put(self, double[::1] numbers):
        """Replace the content (one writer only). Raises ValueError when it does not fit."""
        cdef uint64_t before = self.counter[0]
        if numbers.shape[0] + 1 > self.vector.shape[0]:
            raise ValueError(f"{numbers.shape[0]} numbers do not fit into a box of {self.vector.shape[0] - 1}")
        store_release(&self.counter[0], before + 1)
        fence()
        self.vector[0] = numbers.shape[0]
        memcpy(&self.vector[1], &numbers[0], numbers.shape[0] * sizeof(double))
        fence()
        store_release(&self.counter[0], before + 2)

    def get(self):
        """Return a copy of the content, or None when there is none yet or it is being written."""
        cdef uint64_t before = load_acquire(&self.counter[0])
        if before == 0 or before & 1:
            return None
        copy = np.array(self.vector[1:1 + <int>self.vector[0]])
        fence()
        return copy if load_acquire(&self.counter[0]) == before else None


cdef class Histogram:
    """Histogram of whole microseconds: `counts` uint64 (bins + 1,), last one open; `extremes` float64 (1,).
    """

    def __init__(self, uint64_t[::1] counts, double[::1] largest):
        self.counts, self.largest = counts, largest

    cpdef void add(self, double microseconds) noexcept:
        """Count one value."""
        cdef int last = <int>self.counts.shape[0] - 1
        cdef int k = 0 if microseconds < 0.0 else (last if microseconds >= last else <int>microseconds)
        self.counts[k] += 1
        if microseconds > self.largest[0]:
            self.largest[0] = microseconds


cdef inline int words(int count, int per_word) noexcept:
    return (count + per_word - 1) // per_word


cdef inline int bit_words_of(int channels) noexcept:
    return words(channels, FRESH_WORD) + words(channels, STATUS_WORD) + words(channels - FIRST_DELAYED, DELAY_WORD)


cdef class Record:
    """The record row of a tick. The loop writes the first `head` scalars itself; `fill` copies the rest.

    Layout (signals.Row), with bits as whole float64 numbers:

        head scalars | outputs of the law | values of the channels | fresh bits (one a channel) | status bits
        (two a channel) | delay bits (four a temperature) | the points' estimates
    """
    def __init__(self, double[::1] row, int head):
        self.row, self.head = row, head

    def bind(self, double[::1] value, unsigned char[::1] fresh, unsigned char[::1] status, unsigned char[::1] delay,
             double[::1] outputs):
        """Set the arrays to copy from: the back end's sample and the law's outputs.

        Raises ValueError when they do not make up a row.
        """
        cdef int n = <int>value.shape[0]
        cdef int bits = bit_words_of(n)
        if self.head + n + bits + outputs.shape[0] != self.row.shape[0] or outputs.shape[0] < OUTPUTS_OF_EVERY_RIG:
            raise ValueError(f"{self.head} + {n} + {bits} + {outputs.shape[0]} numbers are not a row of {self.row.shape[0]}")
        self.value, self.fresh, self.status, self.delay, self.outputs = value, fresh, status, delay, outputs

    cpdef void fill(self) noexcept:
        """Copy the bound arrays into the row."""
        cdef int k, n = <int>self.value.shape[0], at = self.head
        memcpy(&self.row[at], &self.outputs[0], OUTPUTS_OF_EVERY_RIG * sizeof(double))
        at += OUTPUTS_OF_EVERY_RIG
        memcpy(&self.row[at], &self.value[0], n * sizeof(double))
        at = pack(self.row, at + n, self.fresh, 0, 1, FRESH_WORD)
        at = pack(self.row, at, self.status, 0, 2, STATUS_WORD)
        at = pack(self.row, at, self.delay, FIRST_DELAYED, 4, DELAY_WORD)
        memcpy(&self.row[at], &self.outputs[OUTPUTS_OF_EVERY_RIG], (self.outputs.shape[0] - OUTPUTS_OF_EVERY_RIG) * sizeof(double))


cdef int pack(double[::1] row, int at, unsigned char[::1] numbers, int first, int bits, int per_word) noexcept:
    """Write the numbers from `first` on into words at `at`, `bits` bits each; return the place after them."""
    cdef int k = first, n = <int>numbers.shape[0], last
    cdef uint64_t word, mask = (1 << bits) - 1
    while k < n:
        last, word = min(k + per_word, n), 0
        while last > k:
            last -= 1
            word = word << bits | (numbers[last] & mask)
        row[at] = <double>word
        at += 1
        k += per_word
    return at


TRIPS, CODE, CODE_S = range(3)
"""Indices in `Remarks.numbers`: fault bits that trip; the drive's last nonzero error code, its t_s."""
LATE_TICKS = 5.0    # a gap of more periods than this is reported beside a fault
LATE_FOR_S = 1.0    # time after the gap for which it is reported


cdef class Remarks:
    """Data that the loop publishes besides the row. Channels are those of the rig.

        ages, verdicts   float64 (channels,): of every tick, as in the law
        numbers          float64 (3,): TRIPS, CODE, CODE_S
        onsets           float64 (64, 3): t_s and tick of each fault bit's onset; longest late tick in the
                         second before, s, else 0
        messages         one a channel, with the t_s of its onset and a seqlock: sequences uint64, times
                         float64 (channels,), texts uint8 (channels, n)

    A message is written when it changes. It is kept when the channel is valid again.
    """

    def __init__(self, double[::1] ages, double[::1] verdicts, double[::1] numbers, double[:, ::1] onsets,
                 uint64_t[::1] sequences, double[::1] times, uint8_t[:, ::1] texts, double period_s=0.001):
        self.ages, self.verdicts, self.numbers, self.onsets = ages, verdicts, numbers, onsets
        self.sequences, self.times, self.texts = sequences, times, texts
        self.bits, self.late_at_s, self.late_s = 0, -1e9, 0.0
        self.late_limit_s = LATE_TICKS * period_s

    cpdef bint fill(self, double[::1] age, double[::1] verdict, uint64_t bits, uint64_t trips, double t_s, double tick,
                    double dt_s, double code) noexcept:
        """Write a tick's remarks (by the loop only); return whether a fault bit is new."""
        cdef uint64_t new = bits & ~self.bits
        cdef int c, n = <int>self.ages.shape[0]
        self.bits = bits
        for c in range(n):
            self.ages[c], self.verdicts[c] = age[c], verdict[c]
        if dt_s > self.late_limit_s:
            self.late_s = dt_s if t_s - self.late_at_s > LATE_FOR_S else max(dt_s, self.late_s)
            self.late_at_s = t_s
        self.numbers[0] = <double>trips
        if code > 0.0 and code != self.numbers[1]:
            self.numbers[1], self.numbers[2] = code, t_s
        if new:
            for c in range(64):
                if new >> c & 1:
                    self.onsets[c, 0], self.onsets[c, 1] = t_s, tick
                    self.onsets[c, 2] = self.late_s if t_s - self.late_at_s <= LATE_FOR_S else 0.0
        return new != 0

    cpdef put(self, int channel, double t_s, bytes text):
        """Replace a channel's message (by the loop only); the end of a long one is cut off."""
        cdef uint64_t before = self.sequences[channel]
        cdef int k, size = <int>self.texts.shape[1]
        cdef const unsigned char[::1] data = text[:size].ljust(size, b"\0")
        store_release(&self.sequences[channel], before + 1)
        fence()
        self.times[channel] = t_s
        memcpy(&self.texts[channel, 0], &data[0], size)
        fence()
        store_release(&self.sequences[channel], before + 2)

    def get(self, int channel):
        """Return (number of changes, t_s of the onset, message), or None while it is being written.

        It is (0, NaN, '') before the first message.
        """
        cdef uint64_t before = load_acquire(&self.sequences[channel])
        if before == 0:
            return 0, float("nan"), ""
        if before & 1:
            return None
        t_s, text = self.times[channel], bytes(self.texts[channel])
        fence()
        if load_acquire(&self.sequences[channel]) != before:
            return None
        return int(before), t_s, text.rstrip(b"\0").decode("utf-8", "replace")


def unpack_readings(double[::1] bit_words, unsigned char[::1] fresh, unsigned char[::1] status, unsigned char[::1] delay):
    """Unpack the words of bits that `Record.fill` packed, into the given arrays over the channels.

    Raises ValueError for another number of words.
    """
    cdef int at, n = <int>fresh.shape[0]
    if bit_words.shape[0] != bit_words_of(n) or status.shape[0] != n or delay.shape[0] != n:
        raise ValueError(f"{bit_words.shape[0]} words of bits for {n} channels, expected {bit_words_of(n)}")
    at = unpack(bit_words, 0, fresh, 0, 1, FRESH_WORD)
    at = unpack(bit_words, at, status, 0, 2, STATUS_WORD)
    unpack(bit_words, at, delay, FIRST_DELAYED, 4, DELAY_WORD)


cdef int unpack(double[::1] row, int at, unsigned char[::1] numbers, int first, int bits, int per_word) noexcept:
    cdef int k, n = <int>numbers.shape[0]
    cdef uint64_t mask = (1 << bits) - 1
    for k in range(first, n):
        numbers[k] = <uint64_t>row[at + (k - first) // per_word] >> bits * ((k - first) % per_word) & mask
    return at + words(n - first, per_word)
