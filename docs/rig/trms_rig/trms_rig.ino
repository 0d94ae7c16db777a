// A rig's side of the frames of docs/rig-frames.md, over USB or a serial line.
// For boards with 32 bits and two encoders on interrupt pins: Teensy, Due, Zero, ESP32, RP2040.
// Yours are the pins, readSensors() and drive(); counts, scales and signs are the wiring's matter.
#include <math.h>
#include <stdint.h>
#include <string.h>

enum { HELLO = 1, WELCOME, READ, READING, COMMAND, ARM = 7, DISARM = 9 };
enum { ARMED = 1, WATCHDOG = 2, EMERGENCY = 4, FAULT = 8 };

const int ENCODER_A[2] = {2, 3}, ENCODER_B[2] = {4, 5};  // pitch, yaw
const int TACHO[2] = {A0, A1};                           // main rotor, tail rotor
const int PWM[2] = {9, 10}, DIRECTION[2] = {7, 8};       // main motor, tail motor
const int STOP_BUTTON = 12;                              // to ground when pressed
const float LIMIT = 2.5f;                                // V at the interface: all of the PWM
const float SAFE[2] = {0, 0};
const uint32_t LONGEST_WATCHDOG = 200;                   // ms

volatile long counts[2];
float command[2];
uint32_t session, applied, status, heard, watchdog = LONGEST_WATCHDOG;
uint8_t line[292];  // the longest frame
int filled;

void stepPitch() { counts[0] += digitalRead(ENCODER_A[0]) == digitalRead(ENCODER_B[0]) ? 1 : -1; }
void stepYaw() { counts[1] += digitalRead(ENCODER_A[1]) == digitalRead(ENCODER_B[1]) ? 1 : -1; }

void readSensors(float *y) {  // raw numbers: counts of the encoders, steps of the converter
  for (int i = 0; i < 2; i++) {
    noInterrupts();
    y[i] = counts[i];
    interrupts();
    y[2 + i] = analogRead(TACHO[i]);
  }
}

void drive(const float *u) {
  for (int i = 0; i < 2; i++) {
    command[i] = u[i] > LIMIT ? LIMIT : u[i] < -LIMIT ? -LIMIT : u[i];
    digitalWrite(DIRECTION[i], command[i] < 0);
    analogWrite(PWM[i], (int)(255 * fabsf(command[i]) / LIMIT));
  }
}

void put(uint8_t *b, uint64_t v, int n) { for (; n--; v >>= 8) *b++ = (uint8_t)v; }
uint32_t get(const uint8_t *b, int n) { uint32_t v = 0; while (n--) v = v << 8 | b[n]; return v; }
float number(const uint8_t *b) { uint32_t v = get(b, 4); float f; memcpy(&f, &v, 4); return f; }

uint32_t crc32(const uint8_t *b, int n) {
  uint32_t c = ~(uint32_t)0;
  while (n--) {
    c ^= *b++;
    for (int k = 8; k--;) c = c >> 1 ^ (0xEDB88320u & -(c & 1));
  }
  return ~c;
}

void answer(int kind, const float *numbers, int n) {  // the head is that of what is answered
  line[5] = kind;
  put(line + 6, n, 2), put(line + 16, micros(), 8), put(line + 24, applied, 4), put(line + 28, status, 4);
  for (int i = 0; i < n; i++) { uint32_t v; memcpy(&v, numbers + i, 4); put(line + 32 + 4 * i, v, 4); }
  put(line + 32 + 4 * n, crc32(line, 32 + 4 * n), 4);
  Serial.write(line, 36 + 4 * n);
}

void obey() {  // a whole frame stands in line
  int kind = line[5], n = get(line + 6, 2);
  uint32_t sequence = get(line + 8, 4), theirs = get(line + 12, 4);
  if (kind == HELLO) {
    if (theirs != session && status & ARMED) return;  // somebody drives
    if (theirs != session) session = theirs, applied = sequence;
    if (n > 1 && number(line + 36) > 0 && number(line + 36) <= 1e-3f * LONGEST_WATCHDOG)
      watchdog = (uint32_t)(1e3f * number(line + 36) + 0.5f);
    const float numbers[3] = {1e-3f * watchdog, 2, 4};
    answer(WELCOME, numbers, 3);
    return;
  }
  if (theirs != session) return;
  if (kind == COMMAND) {
    const float u[2] = {n > 0 ? number(line + 32) : NAN, n > 1 ? number(line + 36) : NAN};
    if (status & ARMED && (int32_t)(sequence - applied) > 0 && isfinite(u[0]) && isfinite(u[1]))
      applied = sequence, heard = millis(), drive(u);
    return;
  }
  if (kind == ARM && !(status & (ARMED | EMERGENCY | FAULT))) status = (status & ~WATCHDOG) | ARMED, heard = millis();
  if (kind == DISARM) status &= ~ARMED, drive(SAFE);
  if (kind != READ && kind != ARM && kind != DISARM) return;
  float y[4];
  readSensors(y);
  answer(READING, y, 4);
}

void drop(int n) { memmove(line, line + n, filled -= n); }

void listen() {
  while (Serial.available() && filled < (int)sizeof line) line[filled++] = (uint8_t)Serial.read();
  while (filled) {  // whole frames; what is none goes byte by byte
    int known = filled < 5 ? filled : 5;
    if (memcmp(line, "TRMS\1", known)) { drop(1); continue; }
    if (filled < 8) return;
    int length = 36 + 4 * (int)get(line + 6, 2);
    if (length > (int)sizeof line) { drop(1); continue; }
    if (filled < length) return;
    if (crc32(line, length - 4) != get(line + length - 4, 4)) { drop(1); continue; }
    static uint8_t rest[sizeof line];
    int left = filled - length;
    memcpy(rest, line + length, left);  // the answer is written where the frame stands
    obey();
    memcpy(line, rest, left);
    filled = left;
  }
}

void setup() {
  Serial.begin(921600);
  for (int i = 0; i < 2; i++) {
    pinMode(ENCODER_A[i], INPUT_PULLUP), pinMode(ENCODER_B[i], INPUT_PULLUP);
    pinMode(PWM[i], OUTPUT), pinMode(DIRECTION[i], OUTPUT);
  }
  pinMode(STOP_BUTTON, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(ENCODER_A[0]), stepPitch, CHANGE);
  attachInterrupt(digitalPinToInterrupt(ENCODER_A[1]), stepYaw, CHANGE);
  drive(SAFE);
}

void loop() {
  listen();
  if (digitalRead(STOP_BUTTON) == LOW && !(status & EMERGENCY)) status = (status & ~ARMED) | EMERGENCY, drive(SAFE);
  if (status & ARMED && millis() - heard > watchdog) status = (status & ~ARMED) | WATCHDOG, drive(SAFE);
}
