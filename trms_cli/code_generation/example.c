/* Drives the controller through recorded samples, compares its commands with those recorded
 * beside them, and times it.
 *
 * usage: mpc_example FILE.csv [PASSES]     summary: largest difference, times
 *        mpc_example --print FILE.csv      the commands, a line a sample
 *
 * A line holds, parted by commas: x_hat (MPC_N_X), w_hat (MPC_N_W), reference
 * (MPC_N_R x (MPC_PREVIEW + 1), the present ones first), u_previous (MPC_N_U) and, if known, the
 * command that is expected (MPC_N_U). Lines that begin with # are left out; nan is a missing value.
 */
#define _POSIX_C_SOURCE 199309L
#include "mpc.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MOST_SAMPLES 100000
#define N_GIVEN (MPC_N_X + MPC_N_W + MPC_N_R * (MPC_PREVIEW + 1) + MPC_N_U)
#define N_COLUMNS (N_GIVEN + MPC_N_U)

static mpc_ctx controller;
static double times[MOST_SAMPLES], least[MOST_SAMPLES];

static int ascending(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Numbers of a line; how many there are. */
static int parse(char *line, double *values) {
    int n = 0;
    char *word = strtok(line, ",\r\n");
    for (; word != NULL && n < N_COLUMNS; word = strtok(NULL, ",\r\n")) values[n++] = atof(word);
    return n;
}

static double microseconds(struct timespec begin, struct timespec end) {
    return 1e6 * (double)(end.tv_sec - begin.tv_sec) + 1e-3 * (double)(end.tv_nsec - begin.tv_nsec);
}

MPC_OBSERVER_FUNCTION
int main(int argc, char **argv) {
    static char line[64 * (N_COLUMNS + 1)];
    const int print = argc > 1 && !strcmp(argv[1], "--print");
    const char *name = argc > 1 + print ? argv[1 + print] : NULL;
    const int passes = !print && argc > 2 ? atoi(argv[2]) : 1;
    int pass, count = 0, failed = 0, compared = 0, number = 0, sample, samples = 0;
    double worst = 0, slowest = 0;
    FILE *file;
    if (name == NULL || (file = fopen(name, "r")) == NULL) {
        fprintf(stderr, "usage: %s [--print] FILE.csv [PASSES]\n", argv[0]);
        return 2;
    }
    for (pass = 0; pass < passes; pass++) {
        int started = 0;
        rewind(file);
        sample = 0;
        for (number = 1; fgets(line, sizeof line, file) != NULL; number++) {
            double v[N_COLUMNS], u[MPC_N_U];
            const double *w = v + MPC_N_X, *r = w + MPC_N_W, *before = v + N_GIVEN - MPC_N_U;
            struct timespec begin, end;
            mpc_info info;
            int i, n;
            if (line[0] == '#') continue;
            n = parse(line, v);
            if (n != N_GIVEN && n != N_COLUMNS) {
                fprintf(stderr, "%s:%d: %d numbers, expected %d or %d\n", name, number, n, N_GIVEN,
                        N_COLUMNS);
                return 2;
            }
            if (!started) mpc_init_at(&controller, before);
            started = 1;
            clock_gettime(CLOCK_MONOTONIC, &begin);
            mpc_step(&controller, v, w, r, before, u, &info);
            clock_gettime(CLOCK_MONOTONIC, &end);
            if (count < MOST_SAMPLES) {
                const double time = microseconds(begin, end);
                times[count++] = time;
                if (pass == 0 || time < least[sample]) least[sample] = time;
                samples = ++sample > samples ? sample : samples;
            }
            failed += info.status == MPC_FAILED;
            for (i = 0; i < MPC_N_U; i++) {
                if (print) printf("%.17g%s", u[i], i + 1 < MPC_N_U ? "," : "\n");
                if (n == N_COLUMNS && !(fabs(u[i] - v[N_GIVEN + i]) <= worst))
                    worst = fabs(u[i] - v[N_GIVEN + i]);
            }
            compared += n == N_COLUMNS;
        }
    }
    fclose(file);
    if (print || count == 0) return count == 0;
    for (sample = 0; sample < samples; sample++)
        if (least[sample] > slowest) slowest = least[sample];
    qsort(times, (size_t)count, sizeof *times, ascending);
    printf("samples %d\n", count);
    printf("failed %d\n", failed);
    if (compared) printf("largest_difference_V %.3g\n", worst);
    printf("median_us %.2f\n", times[count / 2]);
    printf("p99_us %.2f\n", times[(int)(0.99 * (count - 1))]);
    /* The sample that takes longest, in the least disturbed of its passes. */
    printf("slowest_us %.2f\n", slowest);
    printf("max_us %.2f\n", times[count - 1]);
    printf("context_bytes %lu\n", (unsigned long)sizeof(mpc_ctx));
MPC_OBSERVER_CALL
    return 0;
}
