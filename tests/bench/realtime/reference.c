/* The paired reference: a C loop that wakes at the same deadlines as the loop under test, on the same processor, one
 * priority higher, and notes when. What a tick of the loop under test is later than this is the loop's own.
 *     reference CPU PRIORITY FIRST_DEADLINE_NS PERIOD_NS TICKS OUT       rows: deadline, wake (int64, ns) */
#include "rt.h"

int main(int argc, char **argv) {
    if (argc != 7) return 2;
    int64_t deadline = atoll(argv[3]), period = atoll(argv[4]);
    long ticks = atol(argv[5]);
    int64_t *rows = calloc(ticks, 2 * sizeof *rows);
    become_real_time(atoi(argv[1]), atoi(argv[2]));
    while (deadline < now_ns()) deadline += period;
    long k = 0;
    for (; k < ticks; k++) {
        rows[2 * k] = deadline;
        int64_t now = rows[2 * k + 1] = sleep_until(deadline);
        while (deadline <= now) deadline += period;
    }
    save(argv[6], rows, k, 2);
    return 0;
}
