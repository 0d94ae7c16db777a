// What the sketch uses of an Arduino, on a PC: its serial line is a file descriptor, and what it
// writes to its pins is printed. The stop button is pressed while the file named second is there.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <poll.h>
#include <time.h>
#include <unistd.h>

enum { LOW, HIGH, INPUT_PULLUP, OUTPUT, CHANGE, A0 = 14, A1 };

static int wire;
static const char *button;
static int duty[20];

static uint64_t ns() {
    timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000ull + t.tv_nsec;
}
static uint32_t micros() { return (uint32_t)(ns() / 1000); }
static uint32_t millis() { return (uint32_t)(ns() / 1000000); }
static void pinMode(int, int) {}
static int digitalRead(int pin) { return pin == 12 && !access(button, F_OK) ? LOW : HIGH; }
static int analogRead(int pin) { return pin == A0 ? 512 : 511; }
static void digitalWrite(int, int) {}
static void analogWrite(int pin, int value) {
    if (duty[pin] != value) printf("pin %d: %d\n", pin, duty[pin] = value), fflush(stdout);
}
static int digitalPinToInterrupt(int pin) { return pin; }
static void attachInterrupt(int, void (*)(), int) {}
static void noInterrupts() {}
static void interrupts() {}

static struct {
    void begin(long) {}
    int available() {
        pollfd p = {wire, POLLIN, 0};
        return poll(&p, 1, 0) > 0 && p.revents & POLLIN;
    }
    int read() {
        uint8_t b;
        return ::read(wire, &b, 1) == 1 ? b : -1;
    }
    void write(const uint8_t *b, int n) {
        if (::write(wire, b, n) != n) perror("write");
    }
} Serial;

#include SKETCH

int main(int, char **argv) {
    wire = atoi(argv[1]), button = argv[2];
    setup();
    printf("ready\n"), fflush(stdout);
    for (;;) {
        loop();
        usleep(200);
    }
}
