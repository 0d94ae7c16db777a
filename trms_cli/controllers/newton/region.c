/* ------------------------------------------------------------------------------------------
 * The terminal region of a target (Chen & Allgower 1998, Automatica 34): the linear-quadratic
 * regulator of the linearised model with the objective's own weights and some more, its cost to
 * infinity V = |L xi|^2 of xi = (state, last input) - centre, and the largest level of V on which
 * the law keeps the limits and the nonlinear model loses at least the stage cost a period. The
 * first is exact, the second is searched over fixed directions and around the worst of them.
 * ------------------------------------------------------------------------------------------ */

#define REGION_ROUNDS 6
#define REGION_SHELLS 5
#define REGION_CUT 0.85
#define REGION_SMALLEST 0.01
#define REGION_SAFETY 0.8
#define REGION_LEAST_WEIGHT 1e-8
#define REGION_LARGEST_MODULUS (1.0 - 1e-4)
#define REGION_ROUNDING 1e-9
#define REGION_CELL 0.01
#define REGION_DOUBLINGS 60

typedef double mpc_square[MPC_N_V][MPC_N_V];

/* to = a b, with a or b transposed */
static void mpc_rg_multiply(mpc_square to, mpc_square a, int turn_a, mpc_square b, int turn_b) {
    mpc_square product;
    int i, j, k;
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_V; j++) {
            double sum = 0;
            for (k = 0; k < MPC_N_V; k++)
                sum += (turn_a ? a[k][i] : a[i][k]) * (turn_b ? b[j][k] : b[k][j]);
            product[i][j] = sum;
        }
    memcpy(to, product, sizeof product);
}

/* The inverse, by elimination with pivots; whether there is one. */
static int mpc_rg_invert(double *a, int n, double *inverse) {
    int i, j, k;
    for (i = 0; i < n; i++)
        for (j = 0; j < n; j++) inverse[i * n + j] = i == j;
    for (k = 0; k < n; k++) {
        int best = k;
        double pivot;
        for (i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > fabs(a[best * n + k])) best = i;
        pivot = a[best * n + k];
        if (!(fabs(pivot) > 0) || !isfinite(pivot)) return 0;
        for (j = 0; j < n; j++) {
            const double one = a[k * n + j], other = inverse[k * n + j];
            a[k * n + j] = a[best * n + j] / pivot;
            a[best * n + j] = best == k ? a[k * n + j] : one;
            inverse[k * n + j] = inverse[best * n + j] / pivot;
            inverse[best * n + j] = best == k ? inverse[k * n + j] : other;
        }
        for (i = 0; i < n; i++) {
            const double factor = a[i * n + k];
            if (i == k || factor == 0) continue;
            for (j = 0; j < n; j++) {
                a[i * n + j] -= factor * a[k * n + j];
                inverse[i * n + j] -= factor * inverse[k * n + j];
            }
        }
    }
    return 1;
}

static double mpc_rg_largest(mpc_square a) { return mpc_largest(a[0], MPC_N_V * MPC_N_V); }

/* A row of the stage cost's root: weight (of . xi + by . move)^2. */
typedef struct {
    double Q[MPC_N_V][MPC_N_V], S[MPC_N_V][MPC_N_U], R[MPC_N_U][MPC_N_U];
} mpc_stage;

static void mpc_rg_add(mpc_stage *stage, const double *of, const double *by, double weight) {
    int i, j;
    for (i = 0; i < MPC_N_V; i++) {
        for (j = 0; j < MPC_N_V; j++) stage->Q[i][j] += weight * of[i] * of[j];
        for (j = 0; j < MPC_N_U; j++) stage->S[i][j] += weight * of[i] * by[j];
    }
    for (i = 0; i < MPC_N_U; i++)
        for (j = 0; j < MPC_N_U; j++) stage->R[i][j] += weight * by[i] * by[j];
}

/* The stage cost of (xi, move), and what is weighed besides. */
static void mpc_rg_stage(const mpc_ctx *c, mpc_square A, double B[MPC_N_V][MPC_N_U],
                         mpc_stage *stage) {
    const mpc_settings *s = &c->settings;
    double of[MPC_N_V], by[MPC_N_U], more = 1;
    int i, j;
    memset(stage, 0, sizeof *stage);
    for (i = 0; i < MPC_N_WEIGHTED; i++) {
        const double size = s->scale[mpc_weighted_row[i]];
        more = (i ? more : 0) + s->state_weights[i] * size * size / MPC_N_WEIGHTED;
        mpc_rg_add(stage, A[mpc_weighted_row[i]], B[mpc_weighted_row[i]], s->state_weights[i]);
    }
    more *= s->terminal_weight;
    for (i = 0; i < MPC_N_DAMPED; i++) {
        const int row = mpc_damped_row[i];
        for (j = 0; j < MPC_N_V; j++) of[j] = (A[row][j] - (j == row)) / MPC_PERIOD;
        for (j = 0; j < MPC_N_U; j++) by[j] = B[row][j] / MPC_PERIOD;
        mpc_rg_add(stage, of, by, s->rate_weights[i]);
    }
    for (j = 0; j < MPC_N_U; j++) {
        const double size = s->upper[j] > 1e-3 ? s->upper[j] : 1e-3;
        memset(of, 0, sizeof of);
        memset(by, 0, sizeof by);
        by[j] = 1;
        mpc_rg_add(stage, of, by, s->input_weights[j]);
        of[MPC_N_FULL + j] = -1;
        mpc_rg_add(stage, of, by, s->move_weights[j]);
        stage->Q[MPC_N_FULL + j][MPC_N_FULL + j] += REGION_LEAST_WEIGHT / (size * size);
        stage->R[j][j] += more / (size * size) + REGION_LEAST_WEIGHT;
    }
    for (i = 0; i < MPC_N_FULL; i++) {
        const double size = i < MPC_N_X ? s->scale[i] : 1;
        stage->Q[i][i] += (more + REGION_LEAST_WEIGHT) / (size * size);
    }
}

/* The discrete algebraic Riccati equation by doubling (Chu, Fan, Lin & Wang 2004, Int. J. Control
 * 77): P of min sum xi'Q xi + 2 xi'S v + v'R v. Whether it came to an end. */
static int mpc_rg_riccati(mpc_square A, double B[MPC_N_V][MPC_N_U], const mpc_stage *stage,
                          mpc_square P) {
    mpc_square a, g, h, w, inverse, left, right;
    double r[MPC_N_U][MPC_N_U], r_inverse[MPC_N_U][MPC_N_U], half[MPC_N_V][MPC_N_U];
    int i, j, m, round;
    memcpy(r, stage->R, sizeof r);
    if (!mpc_rg_invert(r[0], MPC_N_U, r_inverse[0])) return 0;
    /* without the cross term */
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_U; j++)
            for (m = 0, half[i][j] = 0; m < MPC_N_U; m++)
                half[i][j] += B[i][m] * r_inverse[m][j];
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_V; j++) {
            a[i][j] = A[i][j];
            g[i][j] = 0;
            for (m = 0; m < MPC_N_U; m++) {
                a[i][j] -= half[i][m] * stage->S[j][m];
                g[i][j] += half[i][m] * B[j][m];
            }
        }
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_U; j++)
            for (m = 0, half[i][j] = 0; m < MPC_N_U; m++)
                half[i][j] += stage->S[i][m] * r_inverse[m][j];
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_V; j++)
            for (m = 0, h[i][j] = stage->Q[i][j]; m < MPC_N_U; m++)
                h[i][j] -= half[i][m] * stage->S[j][m];
    for (round = 0; round < REGION_DOUBLINGS; round++) {
        double change;
        mpc_rg_multiply(w, g, 0, h, 0);
        for (i = 0; i < MPC_N_V; i++) w[i][i] += 1;
        if (!mpc_rg_invert(w[0], MPC_N_V, inverse[0])) return 0;
        mpc_rg_multiply(left, a, 0, inverse, 0);   /* a (1 + g h)^-1 */
        mpc_rg_multiply(right, inverse, 0, a, 0);  /* (1 + g h)^-1 a */
        mpc_rg_multiply(w, h, 0, right, 0);
        mpc_rg_multiply(w, a, 1, w, 0);
        change = mpc_rg_largest(w);
        for (i = 0; i < MPC_N_V; i++)
            for (j = 0; j < MPC_N_V; j++) h[i][j] += 0.5 * (w[i][j] + w[j][i]);
        mpc_rg_multiply(w, left, 0, g, 0);
        mpc_rg_multiply(w, w, 0, a, 1);
        for (i = 0; i < MPC_N_V; i++)
            for (j = 0; j < MPC_N_V; j++) g[i][j] += 0.5 * (w[i][j] + w[j][i]);
        mpc_rg_multiply(a, left, 0, a, 0);
        if (!(change < HUGE_VAL)) return 0;
        if (change <= 1e-15 * mpc_rg_largest(h)) {
            memcpy(P, h, sizeof h);
            return 1;
        }
    }
    return 0;
}

/* The largest modulus of a matrix' eigenvalues, by squaring. */
static double mpc_rg_modulus(mpc_square matrix) {
    mpc_square power;
    double logarithm = 0, share = 1;
    int i, j, round;
    memcpy(power, matrix, sizeof power);
    for (round = 0; round < 40; round++) {
        const double size = mpc_rg_largest(power);
        if (!(size > 0)) return 0;
        logarithm += share * log(size);
        share *= 0.5;
        for (i = 0; i < MPC_N_V; i++)
            for (j = 0; j < MPC_N_V; j++) power[i][j] /= size;
        mpc_rg_multiply(power, power, 0, power, 0);
    }
    return exp(logarithm);
}

/* The law u = u_s + K xi and V's matrix P; whether there are such. */
static int mpc_rg_law(mpc_ctx *c, mpc_region *region, mpc_square P) {
    double F[MPC_N_FULL][MPC_N_F], B[MPC_N_V][MPC_N_U] = {{0}}, RB[MPC_N_U][MPC_N_U], inverse[MPC_N_U][MPC_N_U];
    double right[MPC_N_U][MPC_N_V], PB[MPC_N_V][MPC_N_U];
    mpc_square A = {{0}}, closed, power, w;
    mpc_stage stage;
    double slowest, root, kappa;
    int i, j, m, round;
    mpc_advance_with_slopes(c, region->centre, region->centre + MPC_N_FULL, c->stage_next, F);
    for (i = 0; i < MPC_N_FULL; i++) {
        for (j = 0; j < MPC_N_FULL; j++) A[i][j] = F[i][j];
        for (j = 0; j < MPC_N_U; j++) B[i][j] = F[i][MPC_N_FULL + j];
    }
    if (!mpc_finite(A[0], MPC_N_V * MPC_N_V) || !mpc_finite(B[0], MPC_N_V * MPC_N_U)) return 0;
    for (j = 0; j < MPC_N_U; j++) B[MPC_N_FULL + j][j] = 1;
    mpc_rg_stage(c, A, B, &stage);
    if (!mpc_rg_riccati(A, B, &stage, P)) return 0;
    /* K = -(R + B'PB)^-1 (B'PA + S') */
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_U; j++)
            for (m = 0, PB[i][j] = 0; m < MPC_N_V; m++) PB[i][j] += P[i][m] * B[m][j];
    for (i = 0; i < MPC_N_U; i++) {
        for (j = 0; j < MPC_N_U; j++)
            for (m = 0, RB[i][j] = stage.R[i][j]; m < MPC_N_V; m++) RB[i][j] += B[m][i] * PB[m][j];
        for (j = 0; j < MPC_N_V; j++)
            for (m = 0, right[i][j] = stage.S[j][i]; m < MPC_N_V; m++)
                right[i][j] += PB[m][i] * A[m][j];
    }
    if (!mpc_rg_invert(RB[0], MPC_N_U, inverse[0])) return 0;
    for (i = 0; i < MPC_N_U; i++)
        for (j = 0; j < MPC_N_V; j++)
            for (m = 0, region->gain[i][j] = 0; m < MPC_N_U; m++)
                region->gain[i][j] -= inverse[i][m] * right[m][j];
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_V; j++)
            for (m = 0, closed[i][j] = A[i][j]; m < MPC_N_U; m++)
                closed[i][j] += B[i][m] * region->gain[m][j];
    slowest = mpc_rg_modulus(closed);
    if (!(slowest < REGION_LARGEST_MODULUS)) return 0;
    kappa = c->settings.terminal_decay * (1 - slowest * slowest);
    /* V = stage cost under the law + V after it / (1 - kappa) */
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_V; j++) {
            double sum = stage.Q[i][j];
            for (m = 0; m < MPC_N_U; m++) {
                int n;
                sum += stage.S[i][m] * region->gain[m][j] + region->gain[m][i] * stage.S[j][m];
                for (n = 0; n < MPC_N_U; n++)
                    sum += region->gain[m][i] * stage.R[m][n] * region->gain[n][j];
            }
            P[i][j] = sum;
        }
    root = 1 / sqrt(1 - kappa);
    for (i = 0; i < MPC_N_V; i++)
        for (j = 0; j < MPC_N_V; j++) power[i][j] = root * closed[i][j];
    for (round = 0; round < REGION_DOUBLINGS; round++) {
        double change;
        mpc_rg_multiply(w, P, 0, power, 0);
        mpc_rg_multiply(w, power, 1, w, 0);
        change = mpc_rg_largest(w);
        if (!(change < HUGE_VAL)) return 0;
        for (i = 0; i < MPC_N_V; i++)
            for (j = 0; j < MPC_N_V; j++) P[i][j] += 0.5 * (w[i][j] + w[j][i]);
        if (change <= 1e-16 * mpc_rg_largest(P)) return 1;
        mpc_rg_multiply(power, power, 0, power, 0);
    }
    return 0;
}

/* L of P = L'L, upper triangular; whether P is positive definite. */
static int mpc_rg_root(mpc_square P, mpc_square root) {
    int i, j, k;
    memset(root, 0, sizeof(mpc_square));
    for (i = 0; i < MPC_N_V; i++)
        for (j = i; j < MPC_N_V; j++) {
            double sum = P[i][j];
            for (k = 0; k < i; k++) sum -= root[k][i] * root[k][j];
            if (j > i) {
                root[i][j] = sum / root[i][i];
            } else {
                if (!(sum > 0)) return 0;
                root[i][i] = sqrt(sum);
            }
        }
    return 1;
}

/* How far a linear function of xi goes on |L xi| = 1. */
static double mpc_rg_width(mpc_square root, const double *row) {
    double y[MPC_N_V], sum = 0;
    int i, k;
    for (i = 0; i < MPC_N_V; i++) {
        y[i] = row[i];
        for (k = 0; k < i; k++) y[i] -= root[k][i] * y[k];
        y[i] /= root[i][i];
        sum += y[i] * y[i];
    }
    return sqrt(sum);
}

static void mpc_rg_take(double room, double width, double *radius) {
    const double at = room > 0 ? room / (width > 1e-300 ? width : 1e-300) : 0;
    if (at < *radius) *radius = at;
}

/* The radius at which the first limit is touched. */
static double mpc_rg_within_limits(const mpc_ctx *c, mpc_region *region) {
    const mpc_settings *s = &c->settings;
    double radius = HUGE_VAL, row[MPC_N_V];
    int i, j;
    for (j = 0; j < MPC_N_U; j++) {
        const double u = region->centre[MPC_N_FULL + j];
        const double width = mpc_rg_width(region->root, region->gain[j]);
        mpc_rg_take(s->upper[j] - u, width, &radius);
        mpc_rg_take(u - s->lower[j], width, &radius);
#if MPC_RATES_LIMITED
        if (mpc_rate_limited[j]) {
            for (i = 0; i < MPC_N_V; i++) row[i] = region->gain[j][i] - (i == MPC_N_FULL + j);
            mpc_rg_take(s->largest_moves[j], mpc_rg_width(region->root, row), &radius);
        }
#endif
    }
    for (i = 0; i < MPC_N_LIMITED; i++) {
        const double x = region->centre[mpc_limited_row[i]];
        double width;
        for (j = 0; j < MPC_N_V; j++) row[j] = j == mpc_limited_row[i];
        width = mpc_rg_width(region->root, row);
        mpc_rg_take(s->soft_limits[i][1] - x, width, &radius);
        mpc_rg_take(x - s->soft_limits[i][0], width, &radius);
    }
    return radius;
}

/* (V after a period - V + stage cost) / V at xi with L xi = zeta. */
static double mpc_rg_gap(mpc_ctx *c, const mpc_region *region, const double *zeta) {
    const mpc_settings *s = &c->settings;
    double xi[MPC_N_V], full[MPC_N_FULL], u[MPC_N_U], following[MPC_N_V];
    double stage = 0, value = 0, after = 0, gap;
    int i, j;
    for (i = MPC_N_V - 1; i >= 0; i--) {
        xi[i] = zeta[i];
        for (j = i + 1; j < MPC_N_V; j++) xi[i] -= region->root[i][j] * xi[j];
        xi[i] /= region->root[i][i];
        value += zeta[i] * zeta[i];
    }
    for (i = 0; i < MPC_N_FULL; i++) full[i] = region->centre[i] + xi[i];
    for (j = 0; j < MPC_N_U; j++) {
        double move = 0, since;
        for (i = 0; i < MPC_N_V; i++) move += region->gain[j][i] * xi[i];
        since = move - xi[MPC_N_FULL + j];
        u[j] = region->centre[MPC_N_FULL + j] + move;
        following[MPC_N_FULL + j] = move;
        stage += s->input_weights[j] * move * move + s->move_weights[j] * since * since;
    }
    mpc_advance(c, full, u, c->w, c->stage_next);
    for (i = 0; i < MPC_N_FULL; i++) following[i] = c->stage_next[i] - region->centre[i];
    for (i = 0; i < MPC_N_WEIGHTED; i++) {
        const double off = following[mpc_weighted_row[i]];
        stage += s->state_weights[i] * off * off;
    }
    for (i = 0; i < MPC_N_DAMPED; i++) {
        const int row = mpc_damped_row[i];
        const double rate = (c->stage_next[row] - full[row]) / MPC_PERIOD;
        stage += s->rate_weights[i] * rate * rate;
    }
    for (i = 0; i < MPC_N_V; i++) {
        double sum = 0;
        for (j = i; j < MPC_N_V; j++) sum += region->root[i][j] * following[j];
        after += sum * sum;
    }
    gap = (after - value + stage) / value;
    return isfinite(gap) ? gap : HUGE_VAL;
}

/* Drawn numbers that are the same everywhere: the `at`-th, about normal (a sum of four). */
static double mpc_rg_drawn(unsigned long at) {
    double sum = -2;
    int i;
    for (i = 0; i < 4; i++) {
        unsigned long long x = 4ULL * at + (unsigned long long)i + 1;
        x *= 0x9E3779B97F4A7C15ULL;
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9ULL;
        x = (x ^ (x >> 27)) * 0x94D049BB133111EBULL;
        x ^= x >> 31;
        sum += (double)(x >> 11) * (1.0 / 9007199254740992.0);
    }
    return sum;
}

static void mpc_rg_to_length(double *direction, double length) {
    double sum = 0;
    int i;
    for (i = 0; i < MPC_N_V; i++) sum += direction[i] * direction[i];
    for (i = 0; i < MPC_N_V; i++) direction[i] *= length / sqrt(sum);
}

/* Direction `at` of round `round`: fixed ones, or around the worst of the round before. */
static void mpc_rg_direction(const mpc_region_search *search, int round, int at, double spread,
                             double length, double *direction) {
    const unsigned long begin = (unsigned long)(round * MPC_REGION_DIRECTIONS + at) * MPC_N_V;
    const int each = MPC_REGION_DIRECTIONS / MPC_REGION_WORST;
    int i;
    for (i = 0; i < MPC_N_V; i++) {
        direction[i] = mpc_rg_drawn(begin + (unsigned long)i);
        if (round)
            direction[i] = search->worst[at / each][i] + spread / sqrt(MPC_N_V) * direction[i];
        if (round && at < MPC_REGION_WORST) direction[i] = search->worst[at][i];
    }
    mpc_rg_to_length(direction, length);
}

/* Gaps of a round at a radius; the largest. */
static double mpc_rg_round(mpc_ctx *c, const mpc_region *region, int round, double spread,
                           double radius) {
    mpc_region_search *search = &c->region_search;
    double zeta[MPC_N_V], largest = -HUGE_VAL;
    int at;
    for (at = 0; at < MPC_REGION_DIRECTIONS; at++) {
        mpc_rg_direction(search, round, at, spread, radius, zeta);
        search->gaps[at] = mpc_rg_gap(c, region, zeta);
        if (search->gaps[at] > largest) largest = search->gaps[at];
        if (largest > REGION_ROUNDING) break;
    }
    return largest;
}

/* The worst directions of a round, in the order of their gaps. */
static void mpc_rg_find_worst(mpc_region_search *search, int round, double spread) {
    double next[MPC_REGION_WORST][MPC_N_V];
    int rank, at;
    for (rank = MPC_REGION_WORST - 1; rank >= 0; rank--) {
        int worst = 0;
        for (at = 1; at < MPC_REGION_DIRECTIONS; at++)
            if (search->gaps[at] > search->gaps[worst]) worst = at;
        mpc_rg_direction(search, round, worst, spread, 1, next[rank]);
        search->gaps[worst] = -HUGE_VAL;
    }
    memcpy(search->worst, next, sizeof next);
}

/* Whether V falls by the stage cost on all shells within a radius, around the worst directions
 * too. */
static int mpc_rg_falls(mpc_ctx *c, const mpc_region *region, double radius) {
    double spread = 0.5, before = 0;
    int shell, round;
    for (shell = 1; shell <= REGION_SHELLS; shell++)
        if (mpc_rg_round(c, region, 0, 0, radius * shell / REGION_SHELLS) > REGION_ROUNDING)
            return 0;
    for (round = 1; round <= REGION_ROUNDS; round++) {
        mpc_rg_find_worst(&c->region_search, round - 1, before);
        if (mpc_rg_round(c, region, round, spread, radius) > REGION_ROUNDING) return 0;
        before = spread;
        spread *= 0.6;
    }
    return 1;
}

/* The region around a centre; `holds` is 0 where there is none. */
static void mpc_rg_design(mpc_ctx *c, mpc_region *region) {
    mpc_square P;
    double largest, radius;
    region->holds = 0;
    if (!mpc_rg_law(c, region, P) || !mpc_rg_root(P, region->root)) return;
    largest = mpc_rg_within_limits(c, region);
    if (!(largest > 0)) return;
    for (radius = largest; radius >= REGION_SMALLEST * largest; radius *= REGION_CUT)
        if (mpc_rg_falls(c, region, radius)) {
            region->radius = sqrt(REGION_SAFETY) * radius;
            region->holds = 1;
            return;
        }
}

/* The region of the present target: of the first target in its cell of a grid, since an estimated
 * torque moves the target a little at every step. */
static void mpc_rg_choose(mpc_ctx *c) {
    const mpc_settings *s = &c->settings;
    double cell[MPC_N_X + MPC_N_U];
    mpc_region *region = &c->region;
    int i, k;
    for (i = 0; i < MPC_N_X; i++)
        cell[i] = 0.0 + nearbyint(c->target.x[i] / (REGION_CELL * s->scale[i])); /* no -0 */
    for (i = 0; i < MPC_N_U; i++)
        cell[MPC_N_X + i] = 0.0 + nearbyint(
            c->target.u[i] / (REGION_CELL * (s->upper[i] > 1e-3 ? s->upper[i] : 1e-3)));
    /* the centre, with what is remembered of past commands as after a long time at this one */
    memset(region->centre, 0, sizeof region->centre);
    for (i = 0; i < MPC_N_X; i++) region->centre[i] = c->target.x[i];
    for (i = 0; i < MPC_N_U; i++) region->centre[MPC_N_FULL + i] = c->target.u[i];
    mpc_settle_memory(c, region->centre, c->target.u, 1000);
    for (k = 0; k < c->n_regions; k++) {
        mpc_known_region *known = c->regions + k;
        if (memcmp(known->cell, cell, sizeof cell) != 0) continue;
        region->holds = known->region.holds;
        region->radius = known->region.radius;
        memcpy(region->gain, known->region.gain, sizeof region->gain);
        memcpy(region->root, known->region.root, sizeof region->root);
        return;
    }
    mpc_rg_design(c, region);
    k = c->next_region;
    c->next_region = (k + 1) % MPC_REGIONS;
    if (c->n_regions < MPC_REGIONS) c->n_regions++;
    memcpy(c->regions[k].cell, cell, sizeof cell);
    c->regions[k].region = *region;
}

/* What the plan goes on with beyond its end: the local law, or the steady-state input. */
static void mpc_rg_tail(const mpc_ctx *c, double *u) {
    const mpc_region *region = &c->region;
    const double *x = c->trajectory + (MPC_N - 1) * MPC_N_FULL;
    int i, j;
    for (j = 0; j < MPC_N_U; j++) {
        double command = c->target.u[j];
        for (i = 0; i < MPC_N_V && region->holds; i++)
            command += region->gain[j][i] *
                       ((i < MPC_N_FULL ? x[i] : c->plan[MPC_N_Z - MPC_N_U + i - MPC_N_FULL]) -
                        region->centre[i]);
        u[j] = region->holds ? mpc_clipped(command, c->settings.lower[j], c->settings.upper[j])
                             : command;
    }
}
