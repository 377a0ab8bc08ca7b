/* The C twin of the daemon's loop: the same clock, serial framing, Lawicel frames, law, record row, ring and histograms,
 * written plainly in C. What the loop in Python costs is its ratio to this.
 *     twin CPU PRIORITY PERIOD_NS TICKS LAW ENCODER CAN OUT         rows: deadline, wake, end of tick (int64, ns) */
#include "law.h"
#include "rt.h"
#include <math.h>

enum { COLUMNS = 64, ROWS = 8192, BINS = 4096, NODE = 5, MASTER = 127 };
static double ring[ROWS][COLUMNS];
static uint64_t head, lateness[BINS + 1], busy[BINS + 1];
static double time_s[N], limit_s[N];
static law_t law;

/* ---- encoder: AA 55 | 7 | sequence u16 | counts i32 | status u8 | CRC ---- */
static uint8_t buffer[8192];
static int length, last_sequence = -1;
static long frames, bad, lost;

static void put(int role, double value, double low, double high, double now_s) {
    if (low <= value && value <= high) {
        law.value[role] = value;
        time_s[role] = now_s;
        law.fresh[role] = 1;
        law.status[role] = 0;
    } else law.status[role] = 2;
}

static void read_encoder(int fd, double now_s) {
    int got = read(fd, buffer + length, sizeof buffer - length);
    if (got <= 0) return;
    length += got;
    int at = 0;
    while (length - at >= 12) {
        uint8_t *f = buffer + at;
        if (f[0] != 0xAA || f[1] != 0x55 || f[2] != 7) { at++; continue; }
        if (crc_ccitt(f + 2, 8) != (f[10] | f[11] << 8)) { bad++, at++; continue; }
        int sequence = f[3] | f[4] << 8;
        int32_t counts = f[5] | f[6] << 8 | f[7] << 16 | (uint32_t)f[8] << 24;
        if (last_sequence >= 0) lost += (sequence - last_sequence - 1) & 0xFFFF;
        last_sequence = sequence;
        frames++;
        at += 12;
        if (f[9] & 3) law.status[0] = 2;
        else if (length - at < 12) put(0, counts * 0.005, -5000, 5000, now_s);
    }
    memmove(buffer, buffer + at, length -= at);
}

/* ---- drive on Lawicel ASCII ---- */
static char rest[256];
static int rest_length;
static uint16_t status_word;
static double heard_s, beat_s = -1e9;

static int nibble(int c) { return c >= '0' && c <= '9' ? c - '0' : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1; }

static void take_can(const char *m, int size, double now_s) {
    if (m[0] != 't' || size < 5) return;
    int id = nibble(m[1]) << 8 | nibble(m[2]) << 4 | nibble(m[3]), count = m[4] - '0';
    uint8_t d[8] = {0};
    if (count < 0 || count > 8 || size < 5 + 2 * count) return;
    for (int i = 0; i < count; i++) {
        int high = nibble(m[5 + 2 * i]), low = nibble(m[6 + 2 * i]);
        if (high < 0 || low < 0) return;
        d[i] = high << 4 | low;
    }
    if (id == 0x180 + NODE && count == 8) {
        status_word = d[0] | d[1] << 8;
        double state = (status_word & 0x4F) == 0x0F || (status_word & 0x4F) == 0x08 ? 3
                       : (status_word & 0x6F) == 0x27 ? 2 : (status_word & 0x4F) == 0 ? 0 : 1;
        put(5, state, -INFINITY, INFINITY, now_s);
        put(6, 0, -INFINITY, INFINITY, now_s);
        put(4, (d[4] | d[5] << 8 | d[6] << 16 | (uint32_t)d[7] << 24) * 0.001, 0, 60, now_s);
    } else if (id == 0x700 + NODE) heard_s = now_s;
}

static void read_can(int fd, double now_s) {
    char in[4096];
    memcpy(in, rest, rest_length);
    int got = read(fd, in + rest_length, sizeof in - rest_length);
    if (got <= 0) return;
    got += rest_length;
    int at = 0;
    for (int k = 0; k < got; k++)
        if (in[k] == '\r') take_can(in + at, k - at, now_s), at = k + 1;
    rest_length = got - at <= 64 ? got - at : 0;
    memcpy(rest, in + at, rest_length);
}

static int hex(char *to, const uint8_t *d, int n) {
    for (int i = 0; i < n; i++) to[2 * i] = "0123456789ABCDEF"[d[i] >> 4], to[2 * i + 1] = "0123456789ABCDEF"[d[i] & 15];
    return 2 * n;
}

static void write_can(int fd, double drive, int enable, double now_s) {
    uint16_t word = 0;
    int32_t counts = 0;
    int state = status_word & 0x6F;
    if (!enable) word = state == 0x23 || state == 0x27 ? 6 : 0;
    else if ((status_word & 0x4F) == 0x40) word = 6;
    else word = state == 0x21 ? 7 : state == 0x23 || state == 0x27 ? 15 : 0;
    if (enable && state == 0x27) counts = lround((drive < -2.5 ? -2.5 : drive > 2.5 ? 2.5 : drive) / 1e-6);
    uint8_t d[6] = {word & 255, word >> 8, counts & 255, counts >> 8 & 255, counts >> 16 & 255, counts >> 24 & 255};
    char out[64];
    memcpy(out, "t2056", 5);
    int n = 5 + hex(out + 5, d, 6);
    memcpy(out + n, "\rt0800\r", 7), n += 7;
    if (now_s - beat_s >= 0.02) beat_s = now_s, memcpy(out + n, "t77F105\r", 8), n += 8;
    if (write(fd, out, n) < 0) bad++;
}

int main(int argc, char **argv) {
    if (argc != 9) return 2;
    int64_t period = atoll(argv[3]);
    long ticks = atol(argv[4]);
    if (law_load(&law, argv[5])) {
        fprintf(stderr, "%s: not the numbers of a law\n", argv[5]);
        return 3;
    }
    for (int c = 0; c < N; c++) time_s[c] = -INFINITY, limit_s[c] = INFINITY, law.status[c] = 3;
    for (int c = 4; c < 7; c++) limit_s[c] = 0.1, law.status[c] = 1;
    limit_s[0] = 0.1, law.status[0] = 1;
    int encoder = open_raw(argv[6]), can = open_raw(argv[7]);
    const char *setup = "\r\rC\rS8\rO\rt00020105\r";
    if (write(can, setup, strlen(setup)) < 0) return 3;
    int64_t *rows = calloc(ticks, 3 * sizeof *rows);
    become_real_time(atoi(argv[1]), atoi(argv[2]));
    int64_t before = now_ns(), deadline = before + period;
    long slips = 0;
    int64_t start = before;
    printf("%lld\n", (long long)deadline);                  /* so that the paired reference finds our phase */
    fflush(stdout);
    for (long k = 0; k < ticks; k++) {
        int64_t wake = sleep_until(deadline);
        double now_s = wake * 1e-9, dt = (wake - before) * 1e-9, late_us = (wake - deadline) * 1e-3;
        memset(law.fresh, 0, N);
        read_encoder(encoder, now_s);
        read_can(can, now_s);
        for (int c = 0; c < N; c++)
            if (now_s - time_s[c] > limit_s[c] && law.status[c] == 0) law.status[c] = 1;
        law_step(&law, dt, 0, 0.0, 0);
        write_can(can, law.drive, law.enable > 0, now_s);
        double busy_us = (now_ns() - wake) * 1e-3;
        double *row = ring[head % ROWS];
        struct timespec wall;
        clock_gettime(CLOCK_REALTIME, &wall);
        uint64_t fresh = 0, status = 0;
        for (int c = 0; c < N; c++) fresh |= (uint64_t)(law.fresh[c] != 0) << c, status |= (uint64_t)law.status[c] << 2 * c;
        double first[11] = {(wake - start) * 1e-9, wall.tv_sec + wall.tv_nsec * 1e-9, law.tick, late_us, busy_us, slips, 0, dt, 0,
                            0, 0};
        memcpy(row, first, sizeof first);
        memcpy(row + 11, law.value, sizeof law.value);
        row[31] = fresh, row[32] = status, row[33] = 0;
        memcpy(row + 34, law.out, sizeof law.out);
        __atomic_store_n(&head, head + 1, __ATOMIC_RELEASE);
        lateness[late_us < 0 ? 0 : late_us > BINS ? BINS : (int)late_us]++;
        busy[busy_us > BINS ? BINS : (int)busy_us]++;
        rows[3 * k] = deadline, rows[3 * k + 1] = wake;
        before = wake;
        deadline += period;
        int64_t now = rows[3 * k + 2] = now_ns();
        if (now > deadline) {
            long skipped = (now - deadline) / period + ((now - deadline) % period ? 1 : 0);
            slips += skipped;
            deadline += skipped * period;
        }
    }
    save(argv[8], rows, ticks, 3);
    fprintf(stderr, "frames %ld bad %ld lost %ld slips %ld\n", frames, bad, lost, slips);
    return frames > ticks / 2 ? 0 : 4;
}
