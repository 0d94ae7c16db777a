/* One sample of the gap watch: a Kalman filter, and the signatures of its tests.
 *
 * The state is (x, forces, parameters): the first d rows move, the other n - d stay.
 *
 *     P- = F P F' + Q        e = y - h(x-)        S = H P- H' + R = L L'        z = L^-1 e
 *     W  = P- H' L^-T        dx = W z             P = P- - W W'
 *
 * A column of a signature is what a change of unit size, begun some time ago, has done to the
 * error of the estimate (Willsky and Jones 1976, IEEE Trans. Autom. Control 21):
 *
 *     D- = F D + B        s = L^-1 (H D- + E)        D = D- - W s
 *     a += s'z            b += s's
 *
 * so that a^2/b is twice the logarithm of the generalised likelihood ratio, and a/b the size.
 * All matrices are row by row. Without a compiler filter_step.py does the same in NumPy.
 */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("O3") /* -O2 leaves loops without vectors */
#endif
#include <math.h>
#include <stddef.h>

/* Columns that are worked on at once, in registers. */
#define LANES 8
#define MOST_OUTPUTS 16
/* Innovations that the noise is learnt from, in standard deviations. */
#define NOISE_CLIP 5.0

static void add_times(double *restrict to, const double *restrict from, double factor, int count)
{
    for (int m = 0; m < count; ++m)
        to[m] += factor * from[m];
}

/* P- from P; t: (d, n) of scratch. */
static void predict(int d, int n, const double *f, const double *q, double *p, double *t)
{
    for (int i = 0; i < d; ++i) {
        for (int j = 0; j < n; ++j)
            t[i * n + j] = 0.0;
        for (int l = 0; l < n; ++l)
            if (f[i * n + l] != 0.0)
                add_times(t + i * n, p + l * n, f[i * n + l], n);
    }
    for (int i = 0; i < d; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = 0.0;
            for (int l = 0; l < n; ++l)
                sum += t[i * n + l] * f[j * n + l];
            p[i * n + j] = p[j * n + i] = sum;
        }
    for (int i = 0; i < d; ++i)
        for (int j = d; j < n; ++j)
            p[i * n + j] = p[j * n + i] = t[i * n + j];
    for (int i = 0; i < n; ++i)
        p[i * n + i] += q[i];
}

/* L^-1 of a positive s (y, y), which becomes L; 0 if it is not positive. */
static int inverse_root(int y, double *s, double *root)
{
    for (int i = 0; i < y; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = s[i * y + j];
            for (int l = 0; l < j; ++l)
                sum -= s[i * y + l] * s[j * y + l];
            if (i != j)
                s[i * y + j] = sum / s[j * y + j];
            else if (sum > 0.0)
                s[i * y + i] = sqrt(sum);
            else
                return 0;
        }
    for (int i = 0; i < y; ++i)
        for (int j = 0; j < y; ++j) {
            double sum = i == j ? 1.0 : 0.0;
            for (int l = j; l < i; ++l)
                sum -= s[i * y + l] * root[l * y + j];
            root[i * y + j] = j > i ? 0.0 : sum / s[i * y + i];
        }
    return 1;
}

/* Prediction of the covariance and update by a sample.
 *
 * advance: 0 for the first sample, which has nothing before it. state: (y), in: 0 for a channel
 * that is missing, 1 for one that has to be within `gate` standard deviations, 2 for one that is
 * believed; out: 1 where it was used, 0 where it was missing, -1 where it was held back. h: (y, n),
 * e: (y): rows and entries of unused channels become zero. pace: share of the way by which r, of
 * channels that were used, follows what this sample says of it, but not below least. Returns 1 if a covariance is not
 * positive: what comes out is then of no use. */
int trms_watch_update(int advance, int d, int n, int y, const double *f, const double *q,
                      double *h, double *r, double *e, double gate, int *state, double *p,
                      double *root, double *w, double *z, double *dx, double *remainder,
                      const double *least, double pace, double *scratch)
{
    double *c = scratch + d * n, *s = c + n * y;
    if (advance)
        predict(d, n, f, q, p, scratch);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < y; ++j) {
            double sum = 0.0;
            for (int l = 0; l < n; ++l)
                sum += p[i * n + l] * h[j * n + l];
            c[i * y + j] = sum;
        }
    for (int j = 0; j < y; ++j) {
        double variance = r[j];
        for (int l = 0; l < n; ++l)
            variance += h[j * n + l] * c[l * y + j];
        if (state[j] == 1 && e[j] * e[j] > gate * gate * variance)
            state[j] = -1;
        else if (state[j])
            state[j] = 1;
        if (state[j] != 1) {
            e[j] = 0.0;
            for (int l = 0; l < n; ++l)
                h[j * n + l] = c[l * y + j] = 0.0;
        }
    }
    for (int i = 0; i < y; ++i)
        for (int j = 0; j < y; ++j) {
            double sum = i != j ? 0.0 : state[i] == 1 ? r[i] : 1.0;
            for (int l = 0; l < n; ++l)
                sum += h[i * n + l] * c[l * y + j];
            s[i * y + j] = sum;
        }
    if (!inverse_root(y, s, root))
        return 1;
    for (int i = 0; i < y; ++i) {
        z[i] = 0.0;
        for (int j = 0; j <= i; ++j)
            z[i] += root[i * y + j] * e[j];
    }
    for (int i = 0; i < n; ++i) {
        dx[i] = 0.0;
        for (int j = 0; j < y; ++j) {
            double sum = 0.0;
            for (int l = 0; l <= j; ++l)
                sum += c[i * y + l] * root[j * y + l];
            w[i * y + j] = sum;
            dx[i] += sum * z[j];
        }
    }
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double sum = p[i * n + j];
            for (int l = 0; l < y; ++l)
                sum -= w[i * y + l] * w[j * y + l];
            p[i * n + j] = p[j * n + i] = sum;
        }
    for (int j = 0; j < y; ++j) {
        remainder[j] = e[j];
        for (int l = 0; l < n; ++l)
            remainder[j] -= h[j * n + l] * dx[l];
        if (pace > 0.0 && state[j] == 1) { /* E[e remainder] = r */
            double most = NOISE_CLIP * NOISE_CLIP * r[j], shown = e[j] * remainder[j];
            shown = shown > most ? most : shown < -most ? -most : shown;
            r[j] += pace * (shown - r[j]);
            r[j] = r[j] < least[j] ? least[j] : r[j];
        }
    }
    return 0;
}

/* LANES numbers in registers; GCC and Clang make of it what the machine has. */
typedef double lanes __attribute__((vector_size(LANES * sizeof(double)), aligned(8)));

/* Signatures of a number of tests with `slots` onsets each, LANES of which lie together:
 * signature: (tests, slots / LANES, n, LANES); a, energy: (tests, slots).
 * b: (tests, d), c: (tests, y), what a unit of each adds to state and outputs in a sample;
 * live: (slots), 1 for an onset that has been, else 0. f, h, root, w, z, state: as the update has
 * left them. scratch: (d, LANES); columns: (d + y, n + 1), scratch, too. */
void trms_watch_signatures(int d, int n, int y, int tests, int slots, const double *f,
                           const double *h, const double *root, const double *w, const double *z,
                           const int *state, const double *b, const double *c,
                           const double *live, double *signature, double *a, double *energy,
                           double *scratch, int *columns)
{
    lanes *moved = (lanes *)scratch;
    for (int i = 0; i < d + y; ++i) { /* where a row is not zero, first how often */
        const double *row = i < d ? f + i * n : h + (i - d) * n;
        int *of_row = columns + i * (n + 1), count = 0;
        for (int l = 0; l < n; ++l)
            if (row[l] != 0.0)
                of_row[++count] = l;
        of_row[0] = count;
    }
    for (int test = 0; test < tests; ++test)
        for (int slot = 0; slot < slots; slot += LANES) {
            lanes *of = (lanes *)(signature + (size_t)(test * slots + slot) * n);
            lanes *sums = (lanes *)(a + test * slots + slot);
            lanes *squares = (lanes *)(energy + test * slots + slot);
            lanes begun = *(const lanes *)(live + slot), white[MOST_OUTPUTS];
            for (int i = 0; i < d; ++i) {
                const int *of_row = columns + i * (n + 1);
                lanes sum = b[test * d + i] * begun;
                for (int l = 1; l <= of_row[0]; ++l)
                    sum += f[i * n + of_row[l]] * of[of_row[l]];
                moved[i] = sum;
            }
            for (int i = 0; i < d; ++i)
                of[i] = moved[i];
            for (int j = 0; j < y; ++j)
                white[j] = 0.0 * begun;
            for (int j = 0; j < y; ++j) {
                const int *of_row = columns + (d + j) * (n + 1);
                lanes out = (state[j] == 1 ? c[test * y + j] : 0.0) * begun;
                for (int l = 1; l <= of_row[0]; ++l)
                    out += h[j * n + of_row[l]] * of[of_row[l]];
                for (int i = j; i < y; ++i)
                    white[i] += root[i * y + j] * out;
            }
            for (int j = 0; j < y; ++j) {
                *sums += z[j] * white[j];
                *squares += white[j] * white[j];
            }
            for (int i = 0; i < n; ++i) {
                lanes sum = of[i];
                for (int j = 0; j < y; ++j)
                    sum -= w[i * y + j] * white[j];
                of[i] = sum;
            }
        }
}
