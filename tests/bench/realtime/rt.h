/* What the bench's programs share: clock, real-time measures, samples written to a file. */
#ifndef RT_H
#define RT_H
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static inline int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static inline int64_t sleep_until(int64_t deadline) {
    struct timespec t = {deadline / 1000000000, deadline % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR) {}
    return now_ns();
}

static inline void become_real_time(int cpu, int priority) {
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(cpu, &set);
    struct sched_param p = {.sched_priority = priority};
    if (sched_setaffinity(0, sizeof set, &set) || sched_setscheduler(0, SCHED_FIFO, &p) || mlockall(MCL_CURRENT | MCL_FUTURE)) {
        perror("real-time measures (run as root, or allow SCHED_FIFO and locked memory)");
        exit(3);
    }
    int32_t zero = 0;
    int fd = open("/dev/cpu_dma_latency", O_WRONLY);
    if (fd >= 0 && write(fd, &zero, sizeof zero) < 0) perror("/dev/cpu_dma_latency");     /* stays open while we live */
}

static inline void save(const char *path, const int64_t *rows, long count, int columns) {
    FILE *f = fopen(path, "wb");
    if (!f || fwrite(rows, columns * sizeof *rows, count, f) != (size_t)count || fclose(f)) {
        perror(path);
        exit(3);
    }
}

static inline int open_raw(const char *path) {
    int fd = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK);
    struct termios t;
    if (fd < 0 || tcgetattr(fd, &t)) {
        perror(path);
        exit(3);
    }
    cfmakeraw(&t);
    t.c_cc[VMIN] = 1, t.c_cc[VTIME] = 0;
    tcsetattr(fd, TCSANOW, &t);
    tcflush(fd, TCIOFLUSH);
    return fd;
}

static inline uint16_t crc_ccitt(const uint8_t *p, int n) {
    static uint16_t table[256];
    if (!table[1])
        for (int b = 0; b < 256; b++) {
            uint16_t c = b << 8;
            for (int k = 0; k < 8; k++) c = c & 0x8000 ? c << 1 ^ 0x1021 : c << 1;
            table[b] = c;
        }
    uint16_t crc = 0xFFFF;
    while (n--) crc = crc << 8 ^ table[crc >> 8 ^ *p++];
    return crc;
}
#endif
