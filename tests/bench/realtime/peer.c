/* The other end of both wires, light enough not to disturb what is measured: an encoder that streams frames at 1 kHz on
 * one pty, and on another a Lawicel adapter with a CiA-402 drive that answers SDO, SYNC and heartbeats.
 *     peer CPU PRIORITY ENCODER_LINK CAN_LINK PHASE_NS          runs until SIGTERM */
#include "rt.h"
#include <math.h>
#include <poll.h>
#include <pty.h>

enum { NODE = 5, PERIOD = 1000000, OBJECTS = 256 };
static volatile sig_atomic_t stopping;
static void stop(int n) { (void)n; stopping = 1; }

static struct { uint32_t key, value; } objects[OBJECTS];
static int object_count;
static uint32_t *object(uint16_t index, uint8_t sub) {
    uint32_t key = (uint32_t)index << 8 | sub;
    for (int i = 0; i < object_count; i++)
        if (objects[i].key == key) return &objects[i].value;
    objects[object_count].key = key;
    return &objects[object_count++ % OBJECTS].value;
}

static char out[4096];
static int out_length;
static void frame(int id, const uint8_t *data, int size) {
    out_length += sprintf(out + out_length, "t%03X%d", id, size);
    for (int i = 0; i < size; i++) out_length += sprintf(out + out_length, "%02X", data[i]);
    out[out_length++] = '\r';
}

static uint16_t status_word = 0x0240;
static void control_word(uint16_t w) {                       /* enough of CiA-402 for a drive that is never in fault */
    int state = status_word & 0x6F;
    if (!(w & 2)) state = 0x40;
    else if ((w & 7) == 6) state = 0x21;
    else if ((w & 15) == 7 && state == 0x21) state = 0x23;
    else if ((w & 15) == 15 && (state == 0x23 || state == 0x27)) state = 0x27;
    status_word = 0x0210 | state;
}

static int hex(const char *p, int digits) {
    int v = 0;
    while (digits--) {
        int c = *p++;
        v = v << 4 | (c <= '9' ? c - '0' : (c & 7) + 9);
    }
    return v;
}

static void take(char *m, int length) {
    if (m[0] != 't' || length < 5) {                         /* S8, O, C: accepted */
        out[out_length++] = '\r';
        return;
    }
    int id = hex(m + 1, 3), size = m[4] - '0';
    uint8_t d[8] = {0};
    for (int i = 0; i < size && 5 + 2 * i < length; i++) d[i] = hex(m + 5 + 2 * i, 2);
    out[out_length++] = 'z', out[out_length++] = '\r';
    if (id == 0x080) {                                       /* SYNC: TPDO 1 = status word, current, DC link */
        uint8_t answer[8] = {status_word & 255, status_word >> 8, 0, 0, 24000 & 255, 24000 >> 8, 0, 0};
        frame(0x180 + NODE, answer, 8);
    } else if (id == 0x200 + NODE) {
        control_word(d[0] | d[1] << 8);
    } else if (id == 0x600 + NODE) {
        uint32_t *value = object(d[1] | d[2] << 8, d[3]);
        uint8_t answer[8] = {0x60, d[1], d[2], d[3]};
        if (d[0] == 0x40) answer[0] = 0x43, memcpy(answer + 4, value, 4);
        else memcpy(value, d + 4, 4);
        frame(0x580 + NODE, answer, 8);
    }
}

static int link_pty(const char *path, int *slave) {
    int master;
    char name[100];
    if (openpty(&master, slave, name, NULL, NULL)) {
        perror("openpty");
        exit(3);
    }
    struct termios t;
    tcgetattr(*slave, &t);
    cfmakeraw(&t);
    tcsetattr(*slave, TCSANOW, &t);
    fcntl(master, F_SETFL, O_NONBLOCK);
    unlink(path);
    if (symlink(name, path)) {
        perror(path);
        exit(3);
    }
    return master;
}

int main(int argc, char **argv) {
    if (argc != 6) return 2;
    int slaves[2], encoder = link_pty(argv[3], slaves), can = link_pty(argv[4], slaves + 1);
    signal(SIGTERM, stop);
    signal(SIGINT, stop);
    *object(0x1000, 0) = 0x00020192;
    become_real_time(atoi(argv[1]), atoi(argv[2]));
    puts("ready");
    fflush(stdout);
    static char in[8192];
    int in_length = 0;
    uint16_t sequence = 0;
    int64_t deadline = now_ns() / PERIOD * PERIOD + PERIOD + atoll(argv[5]);
    for (long tick = 0; !stopping; ) {
        int64_t now = now_ns();
        if (now >= deadline) {
            deadline += PERIOD;
            tick++;
            int32_t counts = (int32_t)(20.0 * sin(tick * 0.001) / 0.005) + (tick & 1);
            uint8_t f[12] = {0xAA, 0x55, 7, sequence & 255, sequence >> 8, counts & 255, counts >> 8 & 255, counts >> 16 & 255,
                             counts >> 24 & 255, 0};
            sequence++;
            uint16_t crc = crc_ccitt(f + 2, 8);
            f[10] = crc & 255, f[11] = crc >> 8;
            if (write(encoder, f, 12) < 0 && errno != EAGAIN) perror("encoder");
            if (tick % 20 == 0) {
                uint8_t operational = 5;
                frame(0x700 + NODE, &operational, 1);
            }
        }
        int got = read(can, in + in_length, sizeof in - in_length - 1);
        if (got > 0) {
            in_length += got;
            char *start = in, *end;
            while ((end = memchr(start, '\r', in + in_length - start))) {
                *end = 0;
                if (end > start) take(start, end - start);
                start = end + 1;
            }
            in_length -= start - in;
            memmove(in, start, in_length);
            if (in_length > 4000) in_length = 0;
        }
        if (out_length) {
            if (write(can, out, out_length) < 0 && errno != EAGAIN) perror("can");
            out_length = 0;
        }
        int64_t left = deadline - now_ns();
        if (left > 0) {
            struct timespec t = {0, left};
            struct pollfd p = {can, POLLIN, 0};
            ppoll(&p, 1, &t, NULL);
        }
    }
    unlink(argv[3]);
    unlink(argv[4]);
    return 0;
}
