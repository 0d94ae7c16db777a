/* A rig's side of the frames of docs/rig-frames.md: C99, POSIX sockets, and a beam in move().
 *   cc -std=c99 -O2 -o peer peer.c -lm && ./peer 47800
 * To make it yours, read your sensors into y[] in the place of move(), and give u[] to your motors. */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <math.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { HELLO = 1, WELCOME, READ, READING, COMMAND, ARM = 7, DISARM = 9 };
enum { ARMED = 1, WATCHDOG = 2, EMERGENCY = 4, FAULT = 8 };
static const float SAFE[2] = {0, 0}, LIMIT = 2.5f, LONGEST_WATCHDOG = 0.5f;
static float u[2], y[4] = {-0.62f};                   /* u_v, u_h in V; pitch, yaw, speeds in SI */

static void move(double h) {                          /* rotors of first order, a pendulum, a vane */
    static double rate[2];
    y[2] += h * (150 * u[0] - y[2]) / 0.65;
    y[3] += h * (250 * u[1] - y[3]) / 0.3;
    rate[0] += h * (5.9e-5 * y[2] * fabs(y[2]) - 3.9 * sin(y[0] + 0.62) - 0.3 * rate[0]);
    rate[1] += h * (8.6e-6 * y[3] * fabs(y[3]) - 0.27 * y[1] - 0.3 * rate[1]);
    y[0] += h * rate[0];
    y[1] += h * rate[1];
}
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}
static void put(uint8_t *b, uint64_t v, int n) { for (; n--; v >>= 8) *b++ = (uint8_t)v; }
static uint64_t get(const uint8_t *b, int n) { uint64_t v = 0; while (n--) v = v << 8 | b[n]; return v; }
static float number(const uint8_t *b) { uint32_t v = (uint32_t)get(b, 4); float f; memcpy(&f, &v, 4); return f; }
static uint32_t crc32(const uint8_t *b, int n) {
    uint32_t c = ~0u;
    while (n--) { c ^= *b++; for (int k = 8; k--;) c = c >> 1 ^ (0xEDB88320u & -(c & 1)); }
    return ~c;
}
static void say(double t, const char *words) { printf("%9.3f s  %s\n", t, words); fflush(stdout); }

int main(int argc, char **argv) {
    struct sockaddr_in me = {.sin_family = AF_INET, .sin_port = htons(argc > 1 ? atoi(argv[1]) : 47800)}, who;
    struct pollfd line = {socket(AF_INET, SOCK_DGRAM, 0), POLLIN, 0};
    if (bind(line.fd, (struct sockaddr *)&me, sizeof me)) { perror("bind"); return 1; }
    double start = now(), moved = 0, heard = 0;
    float watchdog = LONGEST_WATCHDOG;
    uint32_t session = 0, applied = 0, status = 0;
    say(0, "listening");
    for (;;) {
        uint8_t b[512];
        socklen_t size = sizeof who;
        ssize_t n = poll(&line, 1, 2) > 0 ? recvfrom(line.fd, b, sizeof b, 0, (void *)&who, &size) : 0;
        double t = now() - start;
        for (; moved < t; moved += 0.001) move(0.001);
        if (status & ARMED && t - heard > watchdog) { /* nobody commands: safe, by ourselves */
            status = (status & ~ARMED) | WATCHDOG, memcpy(u, SAFE, sizeof u);
            say(t, "watchdog: safe command");
        }
        int count = n < 36 ? 65 : (int)get(b + 6, 2);
        if (count > 64 || n != 36 + 4 * count || memcmp(b, "TRMS\1", 5) || crc32(b, n - 4) != get(b + n - 4, 4))
            continue;                                 /* no frame of this version */
        uint32_t sequence = (uint32_t)get(b + 8, 4), theirs = (uint32_t)get(b + 12, 4);
        float answer[4];
        int kind = b[5], numbers = 4;
        if (kind == HELLO ? theirs != session && status & ARMED : theirs != session)
            continue;                                 /* somebody else drives, or an old session */
        if (kind == HELLO) {
            if (theirs != session) session = theirs, applied = sequence, say(t, "connected");
            if (count > 1 && number(b + 36) > 0 && number(b + 36) <= LONGEST_WATCHDOG) watchdog = number(b + 36);
            answer[0] = watchdog, answer[1] = 2, answer[2] = 4, numbers = 3;
        } else if (kind == COMMAND) {                 /* armed, newer, finite; cut to the limits */
            float v[2] = {count > 0 ? number(b + 32) : NAN, count > 1 ? number(b + 36) : NAN};
            if (status & ARMED && (int32_t)(sequence - applied) > 0 && isfinite(v[0]) && isfinite(v[1]))
                for (applied = sequence, heard = t, n = 0; n < 2; n++) u[n] = fmaxf(-LIMIT, fminf(LIMIT, v[n]));
            continue;                                 /* a command is not answered */
        } else if (kind == ARM && !(status & (ARMED | EMERGENCY | FAULT))) {
            status = (status & ~WATCHDOG) | ARMED, heard = t, say(t, "armed");
        } else if (kind == DISARM) {
            if (status & ARMED) say(t, "disarmed");
            status &= ~ARMED, memcpy(u, SAFE, sizeof u);
        } else if (kind != READ && kind != ARM) continue;
        if (kind != HELLO) memcpy(answer, y, sizeof y);
        b[5] = kind == HELLO ? WELCOME : READING, put(b + 6, numbers, 2), put(b + 16, (uint64_t)(1e6 * t), 8);
        put(b + 24, applied, 4), put(b + 28, status, 4);
        for (int i = 0; i < numbers; i++) { uint32_t v; memcpy(&v, answer + i, 4), put(b + 32 + 4 * i, v, 4); }
        put(b + 32 + 4 * numbers, crc32(b, 32 + 4 * numbers), 4);
        sendto(line.fd, b, 36 + 4 * numbers, 0, (void *)&who, size);
    }
}
