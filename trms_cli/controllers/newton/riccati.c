/* ------------------------------------------------------------------------------------------
 * The quadratic program of a Newton step, in the changes of the plan: work that grows with the
 * horizon, not with its cube.
 *
 *     minimise   the quadratic model of J + sum_c (mu_c |v_c| + nu_c v_c^2)
 *     subject to the linearised model, bounds of the inputs and of their moves
 *
 * Value functions run backwards over (state, last input): a Riccati recursion (Rao, Wright &
 * Rawlings 1998, JOTA 99). The terminal constraint's multipliers go through it as parameters, so
 * that its exact penalty is left as a small concave problem. Inputs at a bound are taken out of the
 * recursion; those with wrong signs change sides all at once (Judice & Pires 1994, Computers & OR
 * 21), and only periods before the last change are done again. Where that cycles, and where a soft
 * limit is touched, a primal-dual interior point runs over the same recursion.
 * ------------------------------------------------------------------------------------------ */

#define QP_TOLERANCE 1e-9      /* V beyond a bound, and of a wrong sign in the cost per V */
#define QP_MANY (MPC_N_LIMITED ? 4 : 8) /* share of the inputs that is too many not to fall */
#define QP_GAP 1e-12           /* complementarity at which the interior point ends */
#define QP_GAP_TRIED 1e-2      /* at which the sides that it leads to are tried first, */
#define QP_GAP_AGAIN 0.03      /* share of it at which they are again */
#define QP_INSIDE 0.995        /* share of the way to a bound that a step may go */
#define QP_PRICE_ROUNDS 30     /* of Newton's method for the terminal multipliers */

/* Where a state stands: on a soft limit, or beyond it. */
enum { QP_BELOW = -2, QP_ON_LOWER = -1, QP_ON_UPPER = 1, QP_ABOVE = 2 };

#define QP_ONE MPC_N_V                          /* column of what is constant */
#define QP_CONSTANT (MPC_N_V / 4 * 4)           /* where rows of multipliers begin, aligned */
#define QP_PRICES (MPC_N_V + 1)                 /* first column of the multipliers */
#define QP_ON (MPC_N_V + MPC_N_TERMINAL)        /* first row of those of soft limits */
#define QP_OTHERS MPC_N_M                       /* first column of the period's inputs */

/* Where an input stands: free, at a bound, or moved as far as its rate allows. */
enum { QP_FREE = 0, QP_AT_LOWER = -1, QP_AT_UPPER = 1, QP_FALLING = -2, QP_RISING = 2 };

/* What takes the time works on two columns at once, in registers, where the compiler has such
 * vectors: what it makes of loops by itself takes a twentieth longer for a step, and a fifth without
 * -O3. The order of operations in a column is the same. */
#if defined(__GNUC__)
typedef double mpc_lanes __attribute__((vector_size(16), aligned(8), may_alias));
#define QP_KERNEL __attribute__((always_inline)) static inline
#else
typedef double mpc_lanes;
#define QP_KERNEL static
#endif
#define QP_LANES ((int)(sizeof(mpc_lanes) / sizeof(double)))
#define QP_GET(p, i) (*(const mpc_lanes *)((p) + (i) * QP_LANES))
#define QP_PUT(p, i) (*(mpc_lanes *)((p) + (i) * QP_LANES))

/* to += sum over m of a[m] row m, of `columns` (a multiple of 4). */
QP_KERNEL void mpc_qp_add_rows(double *restrict to, const double *restrict rows, int stride,
                               const double *restrict a, int a_stride, int count, int columns) {
    int m;
    for (; columns >= 8 * QP_LANES; columns -= 8 * QP_LANES) {
        mpc_lanes s0 = QP_GET(to, 0), s1 = QP_GET(to, 1), s2 = QP_GET(to, 2), s3 = QP_GET(to, 3);
        mpc_lanes s4 = QP_GET(to, 4), s5 = QP_GET(to, 5), s6 = QP_GET(to, 6), s7 = QP_GET(to, 7);
        const double *row = rows, *factor = a;
        for (m = 0; m < count; m++, row += stride, factor += a_stride) {
            s0 += *factor * QP_GET(row, 0), s1 += *factor * QP_GET(row, 1);
            s2 += *factor * QP_GET(row, 2), s3 += *factor * QP_GET(row, 3);
            s4 += *factor * QP_GET(row, 4), s5 += *factor * QP_GET(row, 5);
            s6 += *factor * QP_GET(row, 6), s7 += *factor * QP_GET(row, 7);
        }
        QP_PUT(to, 0) = s0, QP_PUT(to, 1) = s1, QP_PUT(to, 2) = s2, QP_PUT(to, 3) = s3;
        QP_PUT(to, 4) = s4, QP_PUT(to, 5) = s5, QP_PUT(to, 6) = s6, QP_PUT(to, 7) = s7;
        to += 8 * QP_LANES, rows += 8 * QP_LANES;
    }
    for (; columns >= 4 * QP_LANES; columns -= 4 * QP_LANES) {
        mpc_lanes s0 = QP_GET(to, 0), s1 = QP_GET(to, 1), s2 = QP_GET(to, 2), s3 = QP_GET(to, 3);
        const double *row = rows, *factor = a;
        for (m = 0; m < count; m++, row += stride, factor += a_stride) {
            s0 += *factor * QP_GET(row, 0), s1 += *factor * QP_GET(row, 1);
            s2 += *factor * QP_GET(row, 2), s3 += *factor * QP_GET(row, 3);
        }
        QP_PUT(to, 0) = s0, QP_PUT(to, 1) = s1, QP_PUT(to, 2) = s2, QP_PUT(to, 3) = s3;
        to += 4 * QP_LANES, rows += 4 * QP_LANES;
    }
    for (; columns > 0; columns -= 2 * QP_LANES) {
        mpc_lanes s0 = QP_GET(to, 0), s1 = QP_GET(to, 1);
        const double *row = rows, *factor = a;
        for (m = 0; m < count; m++, row += stride, factor += a_stride)
            s0 += *factor * QP_GET(row, 0), s1 += *factor * QP_GET(row, 1);
        QP_PUT(to, 0) = s0, QP_PUT(to, 1) = s1;
        to += 2 * QP_LANES, rows += 2 * QP_LANES;
    }
}

static int mpc_begins(int k) { return k == 0 || mpc_block[k] != mpc_block[k - 1]; }

/* Change of input i of a block from the one before, in the plan, V. */
static double mpc_since(const mpc_ctx *c, int b, int i) {
    return c->plan[b * MPC_N_U + i] - (b ? c->plan[(b - 1) * MPC_N_U + i] : c->last_u[i]);
}

/* Change of an input that puts it where its constraint is; of a rate, on top of the change before. */
static double mpc_qp_offset(const mpc_ctx *c, int b, int i, int side) {
    const mpc_settings *s = &c->settings;
    const double u = c->plan[b * MPC_N_U + i];
    switch (side) {
    case QP_AT_LOWER: return s->lower[i] - u;
    case QP_AT_UPPER: return s->upper[i] - u;
    case QP_FALLING: return -s->largest_moves[i] - mpc_since(c, b, i);
    case QP_RISING: return s->largest_moves[i] - mpc_since(c, b, i);
    default: return 0;
    }
}

/* A state of the plan less the soft limit that it is taken to. */
static double mpc_off_limit(const mpc_ctx *c, int at) {
    const int i = at % MPC_ROOM(MPC_N_LIMITED), k = at / MPC_ROOM(MPC_N_LIMITED);
    return c->trajectory[k * MPC_N_FULL + mpc_limited_row[i]] -
           c->settings.soft_limits[i][c->qp.touch[at] > 0];
}

/* The errors of the states after period k - 1 in the value function of their changes. */
static void mpc_qp_add_errors(const mpc_ctx *c, int k, double (*restrict M)[MPC_N_M]) {
    const mpc_settings *s = &c->settings;
    const double *x = c->trajectory + (k - 1) * MPC_N_FULL;
    int i;
    for (i = 0; i < MPC_N_WEIGHTED; i++) {
        const int row = mpc_weighted_row[i], ref = mpc_weighted_reference[i];
        const double goal = ref < 0 ? c->target.x[row] : c->reference[(k - 1) * MPC_N_R + ref];
        M[row][row] += 2 * s->state_weights[i];
        M[row][QP_ONE] += 2 * s->state_weights[i] * (x[row] - goal);
    }
    if (c->qp.has_limits)
        for (i = 0; i < MPC_N_LIMITED; i++) {
            const int row = mpc_limited_row[i], at = (k - 1) * MPC_N_LIMITED + i;
            const int touch = c->qp.touch[at];
            if (touch == QP_ON_LOWER || touch == QP_ON_UPPER)
                M[row][QP_PRICES + MPC_N_TERMINAL + c->qp.on[at]] = touch;
            M[row][row] += c->qp.soft_weight[at];
            M[row][QP_ONE] += c->qp.soft_slope[at];
        }
}

/* The cost |L xi|^2 of where the horizon ends, and the row |L xi| - radius of a region, in the value
 * function. */
static void mpc_qp_end_cost(const mpc_ctx *c, double (*restrict M)[MPC_N_M]) {
#if MPC_END_COST
    const mpc_region *region = &c->region;
    double xi[MPC_N_V], at[MPC_N_V], length = 0;
    int i, j, m;
    for (i = 0; i < MPC_N_V; i++) {
        const double end = i < MPC_N_FULL ? c->trajectory[(MPC_N - 1) * MPC_N_FULL + i]
                                          : c->plan[MPC_N_Z - MPC_N_V + i];
        xi[i] = end - region->centre[i];
    }
    for (i = 0; i < MPC_N_V; i++) {
        for (j = i, at[i] = 0; j < MPC_N_V; j++) at[i] += region->root[i][j] * xi[j];
        length += at[i] * at[i];
    }
    length = sqrt(length + MPC_SMOOTH);
    for (i = 0; i < MPC_N_V; i++) {
        double slope = 0;
        for (m = 0; m <= i; m++) slope += region->root[m][i] * at[m];
        M[i][QP_ONE] += 2 * slope;
#if MPC_REGION
        M[i][QP_PRICES] = slope / length;
#endif
        for (j = 0; j < MPC_N_V; j++) {
            double sum = 0;
            for (m = 0; m <= i && m <= j; m++) sum += region->root[m][i] * region->root[m][j];
            M[i][j] += 2 * sum;
        }
    }
#if MPC_REGION
    M[MPC_N_V][QP_ONE] = c->qp.miss[0];
#else
    (void)length;
#endif
#else
    (void)c;
    (void)M;
#endif
}

/* Rows of the multipliers of limits that enter before period k, in the value function there: how
 * far they are off. */
static void mpc_qp_begin_rows(mpc_ctx *c, int k) {
    double (*restrict M)[MPC_N_M] = c->qp.value[k];
    const int most = k * MPC_ROOM(MPC_N_LIMITED);
    int at;
    for (at = 0; at < MPC_ROWS_SOFT && at < most && c->qp.has_limits; at++)
        if (c->qp.touch[at] == QP_ON_LOWER || c->qp.touch[at] == QP_ON_UPPER) {
            memset(M[QP_ON + c->qp.on[at]], 0, sizeof M[0]);
            M[QP_ON + c->qp.on[at]][QP_ONE] = c->qp.touch[at] * mpc_off_limit(c, at);
        }
#if MPC_RATES_LIMITED
    for (at = 0; at < MPC_N_Z && at < (k ? mpc_block[k - 1] + 1 : 0) * MPC_N_U; at++)
        if (c->qp.fast[at]) {
            memset(M[QP_ON + c->qp.on_rate[at]], 0, sizeof M[0]);
            M[QP_ON + c->qp.on_rate[at]][QP_ONE] =
                c->qp.fast[at] * mpc_since(c, at / MPC_N_U, at % MPC_N_U) -
                c->settings.largest_moves[at % MPC_N_U];
        }
#endif
}

/* The value function beyond the last period. */
static void mpc_qp_end(mpc_ctx *c) {
    const mpc_settings *s = &c->settings;
    double (*restrict M)[MPC_N_M] = c->qp.value[MPC_N];
    int i;
    memset(M, 0, sizeof c->qp.value[0]);
    mpc_qp_begin_rows(c, MPC_N);
    mpc_qp_add_errors(c, MPC_N, M);
    if (mpc_has_end_cost(c)) {
        mpc_qp_end_cost(c, M);
        return;
    }
    for (i = 0; i < MPC_N_TERMINAL; i++) {
        M[i][QP_PRICES + i] = 1 / s->scale[i];
        M[MPC_N_V + i][QP_ONE] = c->qp.miss[i];
    }
}

/* What an input's move weighs, apart from the rest: beside a barrier's weight the rest would be
 * lost in rounding. */
typedef struct {
    double move, pull; /* curvature and slope of the move */
    double rest, w;    /* curvature and slope of all else */
} mpc_split;

/* Put an input of a period where its constraint is, and take it out of the value function: a row of
 * h is the cost's slope in it. */
static void mpc_qp_fix(const mpc_qp *q, double (*restrict M)[MPC_N_M],
                       double (*restrict h)[MPC_N_ROW], mpc_split *split, int i, const int *left,
                       int side, double offset, double *restrict gain) {
    const int p = MPC_N_FULL + i, rows = QP_ON + q->n_on;
    const double own = h[i][QP_OTHERS + i];
    int j;
    /* the input is the offset, or the change of the one before it and the offset */
    memset(gain, 0, MPC_N_ROW * sizeof *gain);
    gain[QP_ONE] = -offset;
    for (j = 0; j < MPC_N_V; j++) M[j][QP_ONE] += h[i][j] * offset;
    for (; j < rows; j++) M[j][QP_ONE] += h[i][j + 1] * offset;
    for (j = 0; j < MPC_N_U; j++)
        if (left[j]) {
            h[j][QP_ONE] += h[j][QP_OTHERS + i] * offset;
            split[j].w += h[j][QP_OTHERS + i] * offset;
        }
    if (side == QP_FALLING || side == QP_RISING) {
        gain[p] = -1;
        for (j = 0; j < q->width; j++) M[p][j] += h[i][j];
        for (j = 0; j < MPC_N_V; j++) M[j][p] += h[i][j];
        M[p][p] += own;
        M[p][QP_ONE] += own * offset;
        for (j = 0; j < MPC_N_U; j++)
            if (left[j]) h[j][p] += h[j][QP_OTHERS + i];
    }
}

/* Take the free inputs of a period out of the value function: the `count` last ones of `order`. */
static int mpc_qp_eliminate(mpc_qp *q, double (*restrict M)[MPC_N_M],
                            double (*restrict h)[MPC_N_ROW], mpc_split *split, int b,
                            const signed char *order, int count) {
    const int width = q->width, rows = QP_ON + q->n_on;
    double gains[MPC_N_U][MPC_N_ROW], slopes[MPC_N_U][MPC_N_ROW]; /* the latter with signs turned */
    double own_one[MPC_N_U][2];
    int i, j, m, n;
    for (n = 0; n < count; n++) {
        const int input = order[n];
        const double inverse = 1 / h[input][QP_OTHERS + input];
        if (!(h[input][QP_OTHERS + input] > 0)) return 0;
        for (j = 0; j < MPC_N_ROW; j++) {
            gains[n][j] = h[input][j] * inverse;
            slopes[n][j] = -h[input][j];
        }
        memcpy(q->gain[b][input], gains[n], sizeof gains[n]);
        own_one[n][0] = split[input].move * (split[input].rest * inverse);
        own_one[n][1] = split[input].move * inverse * split[input].w -
                        split[input].pull * (split[input].rest * inverse);
        for (i = n + 1; i < count; i++) {
            const int other = order[i];
            const double a = h[input][QP_OTHERS + other];
            for (m = 0; m < MPC_N_ROW; m++) h[other][m] -= a * gains[n][m];
            split[other].rest -= a * gains[n][QP_OTHERS + other];
            split[other].w -= a * gains[n][QP_ONE];
        }
    }
    for (j = 0; j < MPC_N_V; j++)
        mpc_qp_add_rows(M[j], gains[0], MPC_N_ROW, &slopes[0][j], MPC_N_ROW, count, width);
    for (; j < rows; j++)
        mpc_qp_add_rows(M[j] + QP_CONSTANT, gains[0] + QP_CONSTANT, MPC_N_ROW, &slopes[0][j + 1],
                        MPC_N_ROW, count, width - QP_CONSTANT);
    /* what an input's own move leaves, without the rounding of large numbers that cancel */
    for (n = 0; n < count; n++) {
        const int p = MPC_N_FULL + order[n];
        M[p][p] = own_one[n][0];
        M[p][QP_ONE] = own_one[n][1];
        for (i = n + 1; i < count; i++) {
            M[p][p] += slopes[i][p] * gains[i][p];
            M[p][QP_ONE] += slopes[i][p] * gains[i][QP_ONE];
        }
    }
    return 1;
}

/* Take the inputs of a block out of the value function of (state, input) of its first period: M has
 * the rows of the states, h those of the inputs. */
static int mpc_qp_choose(mpc_ctx *c, int b, double (*restrict M)[MPC_N_M],
                         double (*restrict h)[MPC_N_ROW]) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    mpc_split split[MPC_N_U];
    int i, j, count = 0, fixed, left[MPC_N_U];
    for (i = 0; i < MPC_N_FULL; i++)
        for (j = MPC_N_FULL; j < MPC_N_V; j++) M[i][j] = 0;
    for (i = 0; i < MPC_N_U; i++) {
        const int p = MPC_N_FULL + i, at = b * MPC_N_U + i;
        const double since = mpc_since(c, b, i);
        double move = 2 * s->move_weights[i], pull = move * since;
        (void)at;
#if MPC_RATES_LIMITED
        if (q->is_interior) {
            move += q->rate_weight[at];
            pull += q->rate_slope[at];
        }
#endif
        for (j = 0; j < MPC_N_M; j++) M[p][j] = 0;
        M[p][p] = move;
        M[p][QP_ONE] = -pull;
        for (j = 0; j < MPC_N_U; j++) {
            h[i][QP_OTHERS + j] = h[i][MPC_N_FULL + j];
            h[i][MPC_N_FULL + j] = 0;
        }
        h[i][p] = -move;
#if MPC_RATES_LIMITED
        if (q->fast[at]) {
            const int column = QP_PRICES + MPC_N_TERMINAL + q->on_rate[at];
            h[i][column] = q->fast[at];
            M[p][column] = -q->fast[at];
        }
#endif
        h[i][QP_OTHERS + i] += MPC_REGULARISATION;
        split[i].w = h[i][QP_ONE];
        if (q->is_interior) {
            h[i][QP_OTHERS + i] += q->bound_weight[at];
            split[i].w += q->bound_slope[at];
        }
        split[i].rest = h[i][QP_OTHERS + i];
        split[i].move = move;
        split[i].pull = pull;
        h[i][QP_OTHERS + i] += move;
        h[i][QP_ONE] = split[i].w + pull;
        left[i] = 1;
    }
    for (i = 0; i < MPC_N_U; i++)
        if (q->side[b * MPC_N_U + i]) {
            for (j = 0; j < MPC_N_ROW; j++) q->slope[b][i][j] = h[i][j];
            q->order[b][count++] = (signed char)i;
        }
    fixed = count;
    for (i = 0; i < MPC_N_U; i++)
        if (!q->side[b * MPC_N_U + i]) q->order[b][count++] = (signed char)i;
    for (i = 0; i < fixed; i++) {
        const int input = q->order[b][i], side = q->side[b * MPC_N_U + input];
        if (!(h[input][QP_OTHERS + input] > 0)) return 0;
        left[input] = 0;
        mpc_qp_fix(q, M, h, split, input, left, side, mpc_qp_offset(c, b, input, side),
                   q->gain[b][input]);
    }
    return mpc_qp_eliminate(q, M, h, split, b, q->order[b] + fixed, MPC_N_U - fixed);
}

/* From the value function after period k to that before it. */
static int mpc_qp_back(mpc_ctx *c, int k) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    double (*restrict next)[MPC_N_M] = q->value[k + 1];
    double (*restrict M)[MPC_N_M] = q->value[k];
    double (*restrict F)[MPC_N_F] = q->F[k];
    double left[MPC_N_V][MPC_N_M], h[MPC_N_U][MPC_N_ROW];
    const double *now = c->trajectory + k * MPC_N_FULL;
    const double *before = k ? now - MPC_N_FULL : c->full;
    double curve[MPC_ROOM(MPC_N_DAMPED)], pull[MPC_ROOM(MPC_N_DAMPED)];
    int i, j;
    /* M of (next state, input), by (state, input) to the right: the rest stays */
    for (i = 0; i < MPC_N_V; i++) {
        memset(left[i], 0, MPC_N_FULL * sizeof left[0][0]);
        memcpy(left[i] + MPC_N_FULL, next[i] + MPC_N_FULL, (MPC_N_M - MPC_N_FULL) * sizeof left[0][0]);
        mpc_qp_add_rows(left[i], F[0], MPC_N_F, next[i], 1, MPC_N_FULL, MPC_N_F);
    }
    for (i = 0; i < MPC_N_DAMPED; i++) { /* and the rates on the right */
        const int row = mpc_damped_row[i];
        const double off = (now[row] - before[row]) / MPC_PERIOD -
                           c->rates[k * MPC_N_R + mpc_damped_reference[i]];
        pull[i] = 2 * s->rate_weights[i] * off / MPC_PERIOD;
        curve[i] = 2 * s->rate_weights[i] / (MPC_PERIOD * MPC_PERIOD);
        for (j = 0; j < MPC_N_V; j++) left[row][j] += curve[i] * F[row][j];
        left[row][QP_ONE] += pull[i];
    }
    /* and to the left */
    for (i = 0; i < MPC_N_V; i++) {
        double *restrict row = i < MPC_N_FULL ? M[i] : h[i - MPC_N_FULL];
        if (i < MPC_N_FULL) memset(row, 0, sizeof M[0]);
        else memcpy(row, left[i], sizeof left[0]);
        mpc_qp_add_rows(row, left[0], MPC_N_M, &F[0][i], MPC_N_F, MPC_N_FULL, q->width);
    }
    for (i = 0; i < MPC_N_DAMPED; i++) { /* less the state that a rate is since */
        const int row = mpc_damped_row[i];
        for (j = 0; j < MPC_N_FULL; j++) {
            M[j][row] -= curve[i] * F[row][j];
            M[row][j] -= curve[i] * F[row][j];
        }
        for (; j < MPC_N_V; j++) {
            h[j - MPC_N_FULL][row] -= curve[i] * F[row][j];
            M[row][j] -= curve[i] * F[row][j];
        }
        M[row][row] += curve[i];
        M[row][QP_ONE] -= pull[i];
    }
    for (i = 0; i < MPC_N_U; i++) {
        const double rho = 2 * s->input_weights[i];
        h[i][MPC_N_FULL + i] += rho;
        h[i][QP_ONE] += rho * (c->plan[mpc_block[k] * MPC_N_U + i] - c->target.u[i]);
    }
    if (k) mpc_qp_add_errors(c, k, M);
    for (i = MPC_N_V; i < QP_ON + q->n_on; i++)
        memcpy(M[i] + QP_CONSTANT, next[i] + QP_CONSTANT, sizeof M[0] - QP_CONSTANT * sizeof M[0][0]);
    if (mpc_begins(k)) return mpc_qp_choose(c, mpc_block[k], M, h);
    for (i = 0; i < MPC_N_U; i++) /* the input before goes on */
        memcpy(M[MPC_N_FULL + i], h[i], sizeof M[0]);
    return 1;
}

/* The value functions before periods `from` and earlier; those beyond are right, unless it is the
 * horizon's end. */
static int mpc_qp_sweep(mpc_ctx *c, int from) {
    int k;
    c->qp_iterations++;
    if (from >= MPC_N - 1) mpc_qp_end(c);
    else mpc_qp_begin_rows(c, from + 1);
    for (k = from < MPC_N ? from : MPC_N - 1; k >= 0; k--)
        if (!mpc_qp_back(c, k)) return 0;
    return 1;
}

/* The multipliers: they maximise g'l - l'G l / 2 - sum (|l| - mu)+^2 / (4 nu), the sum over those of
 * the terminal constraint. Newton's method on a concave function, l[0] kept at zero if `without`;
 * whether it came to an end. */
static int mpc_qp_maximise(mpc_ctx *c, int without) {
#if MPC_N_PRICES
    const double mu = c->settings.terminal_linear, nu = c->settings.terminal_quadratic;
    const int n = MPC_N_TERMINAL + c->qp.n_on;
    double (*first)[MPC_N_M] = c->qp.value[0] + MPC_N_V; /* g and -G */
    double *restrict l = c->qp.price, value = -HUGE_VAL, size = 1;
    double L[MPC_N_PRICES][MPC_N_PRICES]; /* Cholesky factor of the curvature by `curved` */
    signed char is_beyond[MPC_N_PRICES], curved[MPC_N_PRICES] = {-1};
    int round, i, j, m;
    for (i = 0; i < n; i++)
        if (1 + fabs(first[i][QP_ONE]) > size) size = 1 + fabs(first[i][QP_ONE]);
    if (without) l[0] = 0;
    for (round = 0; round < QP_PRICE_ROUNDS && n; round++) {
        double r[MPC_N_PRICES], d[MPC_N_PRICES];
        double trial[MPC_N_PRICES], slope = 0, largest = 0, length;
        for (i = 0; i < n; i++) {
            const double beyond = i < MPC_N_TERMINAL ? fabs(l[i]) - mu : 0;
            double sum = first[i][QP_ONE];
            for (j = 0; j < n; j++) sum += first[i][QP_PRICES + j] * l[j];
            is_beyond[i] = beyond > 0;
            if (beyond > 0) sum -= copysign(beyond, l[i]) / (2 * nu);
            r[i] = sum;
        }
        if (without) r[0] = 0;
        for (i = 0; i < n; i++)
            if (!(fabs(r[i]) <= largest)) largest = fabs(r[i]);
        if (!(largest < HUGE_VAL)) return 0;
        if (largest <= (round > 1 ? 1e-13 : 1e-17) * size) return 1;
        for (i = 0; i < n && memcmp(is_beyond, curved, (size_t)n); i++)
            for (j = 0; j <= i; j++) {
                const int is_left_out = without && j == 0;
                double sum = is_left_out ? i == 0 : -first[i][QP_PRICES + j];
                for (m = 0; m < j; m++) sum -= L[i][m] * L[j][m];
                if (j < i) {
                    L[i][j] = sum / L[j][j];
                } else {
                    if (!is_left_out) sum += 1e-10 + (is_beyond[i] ? 1 / (2 * nu) : 0);
                    if (!(sum > 0)) return 0;
                    L[i][i] = sqrt(sum);
                }
            }
        memcpy(curved, is_beyond, (size_t)n);
        for (i = 0; i < n; i++) {
            double sum = r[i];
            for (j = 0; j < i; j++) sum -= L[i][j] * d[j];
            d[i] = sum / L[i][i];
        }
        for (i = n - 1; i >= 0; i--) {
            double sum = d[i];
            for (j = i + 1; j < n; j++) sum -= L[j][i] * d[j];
            d[i] = sum / L[i][i];
        }
        for (i = 0; i < n; i++) slope += r[i] * d[i];
        for (length = 1; length > 1e-6; length *= 0.5) {
            double v = 0;
            for (i = 0; i < n; i++) trial[i] = l[i] + length * d[i];
            for (i = 0; i < n; i++) {
                const double beyond = i < MPC_N_TERMINAL ? fabs(trial[i]) - mu : 0;
                double sum = 0;
                for (j = 0; j < n; j++) sum -= first[i][QP_PRICES + j] * trial[j];
                v += trial[i] * (first[i][QP_ONE] - 0.5 * sum);
                if (beyond > 0) v -= beyond * beyond / (4 * nu);
            }
            if (value == -HUGE_VAL ||
                v >= value + 1e-4 * length * slope - 1e-13 * (1 + fabs(value))) {
                value = v;
                break;
            }
        }
        memcpy(l, trial, (size_t)n * sizeof *trial);
        if (round > 2 && slope < 1e-22 * size * size) return 1;
    }
#else
    (void)c;
    (void)without;
#endif
    return 1;
}

static int mpc_qp_prices(mpc_ctx *c) {
    if (!mpc_qp_maximise(c, 0)) return 0;
    /* inside a region is as good as on its edge */
    if (mpc_in_region(c) && c->qp.price[0] < 0) return mpc_qp_maximise(c, 1);
    return 1;
}

/* Where input i of a block stands in the solution, by its bounds, its rate and their multipliers:
 * `turn`, and `fast_turn`. Whether it stood elsewhere. */
static int mpc_qp_stand(mpc_ctx *c, int b, int i, const double *x, const double *p,
                        const double *u) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    const int at = b * MPC_N_U + i;
    const double to = c->plan[at] + u[i];
    int j, side = q->side[at], fast = 0;
    if (side) {
        const double *h = q->slope[b][i];
        double y = h[QP_ONE];
        for (j = 0; j < MPC_N_FULL; j++) y += h[j] * x[j];
        for (j = 0; j < MPC_N_U; j++)
            y += h[MPC_N_FULL + j] * p[j] + h[QP_OTHERS + j] * u[j];
        for (j = 0; j < MPC_N_TERMINAL + q->n_on; j++) y += h[QP_PRICES + j] * q->price[j];
        if (side < 0 ? y < -QP_TOLERANCE : y > QP_TOLERANCE) side = QP_FREE;
    }
#if MPC_RATES_LIMITED
    fast = q->fast[at];
    if (fast && q->price[MPC_N_TERMINAL + q->on_rate[at]] < -QP_TOLERANCE) {
        fast = 0;
        side = q->side[at];
    } else if (fast && !side) { /* the rate alone is left */
        side = fast < 0 ? QP_FALLING : QP_RISING;
        fast = 0;
    }
#endif
    if (to < s->lower[i] - QP_TOLERANCE || to > s->upper[i] + QP_TOLERANCE) {
        if (side == QP_FALLING || side == QP_RISING) fast = side / 2;
        side = to < s->lower[i] ? QP_AT_LOWER : QP_AT_UPPER;
    }
#if MPC_RATES_LIMITED
    if (mpc_rate_limited[i]) {
        const double move = mpc_since(c, b, i) + u[i] - p[i];
        if (fabs(move) > s->largest_moves[i] + QP_TOLERANCE) {
            if (side == QP_AT_LOWER || side == QP_AT_UPPER) fast = move < 0 ? -1 : 1;
            else side = move < 0 ? QP_FALLING : QP_RISING;
        }
    }
    q->fast_turn[at] = (signed char)fast;
    if (fast != q->fast[at]) {
        q->turn[at] = (signed char)side;
        return 1;
    }
#else
    (void)fast;
#endif
    q->turn[at] = (signed char)side;
    return side != q->side[at];
}

/* Changes of inputs and states; how many inputs stand on a wrong side, and (`last`) the last
 * period of them. Their right sides are taken down in `turn`. */
static int mpc_qp_forward(mpc_ctx *c, int *last) {
    mpc_qp *q = &c->qp;
    double p[MPC_N_U] = {0}, u[MPC_N_U] = {0};
    int k, i, j, wrong = 0;
    memset(q->dx[0], 0, sizeof q->dx[0]);
    *last = 0;
    for (k = 0; k < MPC_N; k++) {
        const double *x = q->dx[k];
        const int b = mpc_block[k];
        if (mpc_begins(k)) {
            memcpy(p, u, sizeof p);
            for (j = MPC_N_U - 1; j >= 0; j--) {
                const int input = q->order[b][j];
                const double *K = q->gain[b][input];
                double sum = K[QP_ONE];
                int m;
                for (m = 0; m < MPC_N_FULL; m++) sum += K[m] * x[m];
                for (m = 0; m < MPC_N_U; m++) sum += K[MPC_N_FULL + m] * p[m];
                for (m = 0; m < MPC_N_TERMINAL + q->n_on; m++)
                    sum += K[QP_PRICES + m] * q->price[m];
                for (m = j + 1; m < MPC_N_U; m++)
                    sum += K[QP_OTHERS + q->order[b][m]] * u[q->order[b][m]];
                u[input] = -sum;
            }
            for (i = 0; i < MPC_N_U; i++) {
                const int at = b * MPC_N_U + i;
                q->dz[at] = u[i];
                if (q->is_interior) continue;
                if (mpc_qp_stand(c, b, i, x, p, u)) {
                    wrong++;
                    *last = k;
                }
            }
        }
        for (i = 0; i < MPC_N_FULL; i++) {
            double sum = 0;
            for (j = 0; j < MPC_N_FULL; j++) sum += q->F[k][i][j] * x[j];
            for (j = 0; j < MPC_N_U; j++) sum += q->F[k][i][MPC_N_FULL + j] * u[j];
            q->dx[k + 1][i] = sum;
        }
    }
    return wrong;
}

/* The states that changes of the inputs lead to. */
static void mpc_qp_simulate(mpc_ctx *c, const double *dz) {
    mpc_qp *q = &c->qp;
    int k, i, j;
    memset(q->dx[0], 0, sizeof q->dx[0]);
    for (k = 0; k < MPC_N; k++)
        for (i = 0; i < MPC_N_FULL; i++) {
            double sum = 0;
            for (j = 0; j < MPC_N_FULL; j++) sum += q->F[k][i][j] * q->dx[k][j];
            for (j = 0; j < MPC_N_U; j++)
                sum += q->F[k][i][MPC_N_FULL + j] * dz[mpc_block[k] * MPC_N_U + j];
            q->dx[k + 1][i] = sum;
        }
}

/* A multiplier of its own for what is held; whether there is room. */
static int mpc_qp_hold(mpc_qp *q, int *on, double price) {
    if (q->n_on == MPC_N_ON) return 0;
    q->price[MPC_N_TERMINAL + q->n_on] = price;
    *on = q->n_on++;
    return 1;
}

/* Soft limits by where each stands: beyond it, its price; on it, a multiplier of its own, as the
 * terminal constraint has. They are counted from the horizon's end: a change amid it leaves those
 * beyond where they are. Whether there is room for all. */
static int mpc_qp_weigh_touched(mpc_ctx *c) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    int i, k;
    q->has_limits = q->n_on = 0;
    for (k = MPC_N - 1; k >= 0 && MPC_N_ON; k--) {
        for (i = 0; i < MPC_N_LIMITED; i++) {
            const int at = k * MPC_N_LIMITED + i, touch = q->touch[at];
            q->soft_weight[at] = q->soft_slope[at] = 0;
            if (!touch) continue;
            q->has_limits = 1;
            if (touch == QP_BELOW || touch == QP_ABOVE) {
                q->soft_weight[at] = 2 * s->soft_quadratic;
                q->soft_slope[at] = q->soft_weight[at] * mpc_off_limit(c, at) +
                                    (touch < 0 ? -s->soft_linear : s->soft_linear);
            } else if (!mpc_qp_hold(q, q->on + at, q->touch_price[at])) {
                return 0;
            }
        }
#if MPC_RATES_LIMITED
        for (i = 0; i < MPC_N_U && mpc_begins(k); i++) {
            const int at = mpc_block[k] * MPC_N_U + i;
            if (q->fast[at] && !mpc_qp_hold(q, q->on_rate + at, 0)) return 0;
        }
#endif
    }
    q->width = (QP_PRICES + MPC_N_TERMINAL + q->n_on + 3) / 4 * 4;
    return 1;
}

/* How far a predicted state is beyond a limit that it has not been taken to. */
static double mpc_qp_beyond(const mpc_ctx *c, int k, int i) {
    const mpc_settings *s = &c->settings;
    const int row = mpc_limited_row[i];
    const double x = c->trajectory[k * MPC_N_FULL + row] + c->qp.dx[k + 1][row];
    const double low = s->soft_limits[i][0] - x, high = x - s->soft_limits[i][1];
    return c->qp.touch[k * MPC_N_LIMITED + i] ? 0 : low > high ? low : high;
}

/* Where each soft limit stands in the solution. How many stood elsewhere; `last`: the last period
 * of those. Of periods in a row beyond a limit the furthest is taken to it: a trajectory touches a
 * limit at a few points, and what is held there holds the others. */
static int mpc_qp_touch(mpc_ctx *c, int *last) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    int k, i, wrong = 0;
    for (k = 0; k < MPC_N; k++)
        for (i = 0; i < MPC_N_LIMITED; i++) {
            const int at = k * MPC_N_LIMITED + i, row = mpc_limited_row[i];
            const double x = c->trajectory[k * MPC_N_FULL + row] + q->dx[k + 1][row];
            const double low = s->soft_limits[i][0] - x, high = x - s->soft_limits[i][1];
            const double off = q->touch[at] < 0 ? low : high;
            int touch = q->touch[at];
            if (touch == QP_ON_LOWER || touch == QP_ON_UPPER) {
                q->touch_price[at] = q->price[MPC_N_TERMINAL + q->on[at]];
                if (q->touch_price[at] < -QP_TOLERANCE) touch = 0;
                else if (q->touch_price[at] > s->soft_linear + QP_TOLERANCE) touch *= 2;
            } else if (touch && off < -QP_TOLERANCE) {
                touch /= 2;
            }
            if (!q->touch[at] && (low > QP_TOLERANCE || high > QP_TOLERANCE) &&
                (!k || mpc_qp_beyond(c, k - 1, i) <= mpc_qp_beyond(c, k, i)) &&
                (k + 1 == MPC_N || mpc_qp_beyond(c, k + 1, i) < mpc_qp_beyond(c, k, i)))
                touch = low > high ? QP_ON_LOWER : QP_ON_UPPER;
            q->touch_turn[at] = (signed char)touch;
            if (touch == q->touch[at]) continue;
            wrong++;
            if (k >= *last) *last = k + 1; /* it enters before the period after */
        }
    return wrong;
}

/* Take a limit to the side where it stands in the solution. */
static void mpc_qp_turn_limit(mpc_ctx *c, int at) {
    mpc_qp *q = &c->qp;
    if (q->touch_turn[at] == q->touch[at]) return;
    if (!q->touch[at]) q->touch_price[at] = 0;
    if (q->touch[at] == QP_BELOW || q->touch[at] == QP_ABOVE)
        q->touch_price[at] = c->settings.soft_linear;
    q->touch[at] = q->touch_turn[at];
}

/* Take all limits to where they stand in the solution; while one lets go, none is held anew. What is
 * beyond a limit then is often so because of what was held to no use. */
static void mpc_qp_turn_limits(mpc_ctx *c) {
    const mpc_qp *q = &c->qp;
    int at, released = 0;
    for (at = 0; at < MPC_ROWS_SOFT; at++) released |= q->touch[at] && !q->touch_turn[at];
    for (at = 0; at < MPC_ROWS_SOFT; at++)
        if (q->touch[at] || !released) mpc_qp_turn_limit(c, at);
}

/* Turn the last of the wrong sides alone: slower, and it does not cycle (Murty 1974, Linear
 * Algebra and its Applications 9). */
static int mpc_qp_turn_last(mpc_ctx *c) {
    mpc_qp *q = &c->qp;
    int k, i;
    for (k = MPC_N - 1; k >= 0; k--) {
        for (i = 0; i < MPC_N_LIMITED; i++) {
            const int at = k * MPC_N_LIMITED + i;
            if (q->touch_turn[at] == q->touch[at]) continue;
            mpc_qp_turn_limit(c, at);
            return k + 1;
        }
        for (i = 0; i < MPC_N_U && mpc_begins(k); i++) {
            const int at = mpc_block[k] * MPC_N_U + i;
            int same = q->turn[at] == q->side[at];
#if MPC_RATES_LIMITED
            same = same && q->fast_turn[at] == q->fast[at];
            q->fast[at] = q->fast_turn[at];
#endif
            if (same) continue;
            q->side[at] = q->turn[at];
            return k;
        }
    }
    return 0;
}

/* Exchange wrong sides, all at once or the last alone, until none is left; whether that came to
 * an end. */
static int mpc_qp_pivot(mpc_ctx *c, int rounds, int all_at_once) {
    mpc_qp *q = &c->qp;
    int from = MPC_N - 1, first = 0, round;
    for (round = 0; round < rounds; round++) {
        int last, wrong;
        if (!mpc_qp_weigh_touched(c)) return 0;
        if (!mpc_qp_sweep(c, from) || !mpc_qp_prices(c)) return 0;
        wrong = mpc_qp_forward(c, &last);
        wrong += mpc_qp_touch(c, &last);
        if (!wrong) return 1;
        if (!round) first = wrong;
        /* too many for a start, or they do not become less: the interior point is faster */
        if (all_at_once && (3 * first > MPC_N_Z ||
                            (round > 2 && 4 * wrong >= 3 * first && QP_MANY * wrong > MPC_N_Z)))
            return 0;
        if (all_at_once) {
            memcpy(q->side, q->turn, sizeof q->side);
#if MPC_RATES_LIMITED
            memcpy(q->fast, q->fast_turn, sizeof q->fast);
#endif
            mpc_qp_turn_limits(c);
        } else {
            last = mpc_qp_turn_last(c);
        }
        from = last;
    }
    return 0;
}

/* Pairs of the interior point: bounds of the unknowns, of their moves, then soft limits with the
 * room that their violation makes. Each: lower, upper. */
#define QP_MOVES (2 * MPC_N_Z)
#define QP_LIMITS (QP_MOVES + 2 * MPC_N_Z * MPC_RATES_LIMITED)

/* A hard pair around a value: the weight and the slope that it has in the recursion. */
static void mpc_qp_barrier(const mpc_pair *pair, double value, double mu, double *weight,
                           double *slope) {
    *weight = pair[0].price / pair[0].room + pair[1].price / pair[1].room;
    *slope = -*weight * value - mu / pair[0].room + mu / pair[1].room;
}

/* Where a hard pair goes with a value that moves by d. */
static void mpc_qp_follow(mpc_pair *pair, double d, double mu) {
    pair[0].d_room = d;
    pair[0].d_price = (mu - pair[0].price * d) / pair[0].room - pair[0].price;
    pair[1].d_room = -d;
    pair[1].d_price = (mu + pair[1].price * d) / pair[1].room - pair[1].price;
}

/* One side of a soft limit: y of the limit with room t, z of the violation s; both follow d, the
 * move towards the limit. The slope of the price in d is weight * d + slope. */
static void mpc_qp_soften(const mpc_ctx *c, const mpc_pair *limit, const mpc_pair *beyond,
                          double mu, double *weight, double *slope) {
    const double t = limit->room, y = limit->price, s = beyond->room, z = beyond->price;
    const double curve = 2 * c->settings.soft_quadratic;
    const double rest = c->settings.soft_linear + curve * s - y - z, own = curve * s + z;
    const double first = mu - s * z - s * rest, whole = t + y * s / own;
    *weight = *slope = 0;
    if (!(t < HUGE_VAL)) return; /* a side without a limit */
    *weight = y / whole;
    *slope = y + (mu - t * y - y * first / own) / whole;
}

static void mpc_qp_follow_soft(const mpc_ctx *c, mpc_pair *limit, mpc_pair *beyond, double d,
                               double mu) {
    const double s = beyond->room, z = beyond->price;
    const double curve = 2 * c->settings.soft_quadratic;
    const double rest = c->settings.soft_linear + curve * s - limit->price - z;
    double weight, slope;
    limit->d_room = limit->d_price = beyond->d_room = beyond->d_price = 0;
    if (!(limit->room < HUGE_VAL)) return;
    mpc_qp_soften(c, limit, beyond, mu, &weight, &slope);
    limit->d_price = slope + weight * d - limit->price;
    beyond->d_room = (mu - s * z - s * rest + s * limit->d_price) / (curve * s + z);
    beyond->d_price = rest + curve * beyond->d_room - limit->d_price;
    limit->d_room = beyond->d_room - d;
}

/* An input that keeps clear of its bounds and rates, and from it rooms and prices. */
static void mpc_qp_begin_inside(mpc_ctx *c, int soft) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    int at, i, k;
    for (at = 0; at < MPC_N_Z; at++) {
        const int j = at % MPC_N_U;
        const double before = at < MPC_N_U ? c->last_u[j] : c->plan[at - MPC_N_U] + q->inside[at - MPC_N_U];
        const double span = s->upper[j] - s->lower[j], edge = 0.02 * span;
        double to = mpc_clipped(c->plan[at], s->lower[j] + edge, s->upper[j] - edge);
#if MPC_RATES_LIMITED
        if (mpc_rate_limited[j])
            to = mpc_clipped(to, before - 0.5 * s->largest_moves[j], before + 0.5 * s->largest_moves[j]);
#endif
        q->inside[at] = to - c->plan[at];
        q->pair[2 * at].room = to - s->lower[j];
        q->pair[2 * at + 1].room = s->upper[j] - to;
        q->pair[2 * at].price = q->pair[2 * at + 1].price = 1;
#if MPC_RATES_LIMITED
        {
            mpc_pair *move = q->pair + QP_MOVES + 2 * at;
            const double most = mpc_rate_limited[j] ? s->largest_moves[j] : 0;
            move[0].room = most ? to - before + most : 1;
            move[1].room = most ? most - (to - before) : 1;
            move[0].price = move[1].price = most ? 1 : 0;
        }
#else
        (void)before;
#endif
    }
    memset(q->soft_weight, 0, sizeof q->soft_weight);
    memset(q->soft_slope, 0, sizeof q->soft_slope);
    mpc_qp_simulate(c, q->inside);
    for (k = 0; k < MPC_N && soft; k++)
        for (i = 0; i < MPC_N_LIMITED; i++) {
            mpc_pair *pair = q->pair + QP_LIMITS + 4 * (k * MPC_N_LIMITED + i);
            const double x = c->trajectory[k * MPC_N_FULL + mpc_limited_row[i]] +
                             q->dx[k + 1][mpc_limited_row[i]];
            const double span = s->soft_limits[i][1] - s->soft_limits[i][0];
            const double least = span < HUGE_VAL ? 0.05 * span : 1e-3;
            for (at = 0; at < 2; at++) {
                const double room = at ? s->soft_limits[i][1] - x : x - s->soft_limits[i][0];
                const double beyond = room < least ? least - room : least;
                pair[2 * at].room = room + beyond;
                pair[2 * at + 1].room = beyond;
                pair[2 * at].price = pair[2 * at + 1].price =
                    0.5 * (s->soft_linear + 2 * s->soft_quadratic * beyond);
                if (!(room < HUGE_VAL)) pair[2 * at].price = pair[2 * at + 1].price = 0;
            }
        }
}

/* What the pairs weigh in the recursion, around the present point. */
static void mpc_qp_weigh(mpc_ctx *c, int soft, double mu) {
    mpc_qp *q = &c->qp;
    int at, i, k;
    for (at = 0; at < MPC_N_Z; at++) {
        mpc_qp_barrier(q->pair + 2 * at, q->inside[at], mu, q->bound_weight + at,
                       q->bound_slope + at);
#if MPC_RATES_LIMITED
        q->rate_weight[at] = q->rate_slope[at] = 0;
        if (mpc_rate_limited[at % MPC_N_U])
            mpc_qp_barrier(q->pair + QP_MOVES + 2 * at,
                           q->inside[at] - (at < MPC_N_U ? 0 : q->inside[at - MPC_N_U]), mu,
                           q->rate_weight + at, q->rate_slope + at);
#endif
    }
    for (k = 0; k < MPC_N && soft; k++)
        for (i = 0; i < MPC_N_LIMITED; i++) {
            const double x = q->dx[k + 1][mpc_limited_row[i]];
            double low, high, low_slope, high_slope;
            at = k * MPC_N_LIMITED + i;
            mpc_qp_soften(c, q->pair + QP_LIMITS + 4 * at, q->pair + QP_LIMITS + 4 * at + 1, mu,
                          &low, &low_slope);
            mpc_qp_soften(c, q->pair + QP_LIMITS + 4 * at + 2, q->pair + QP_LIMITS + 4 * at + 3,
                          mu, &high, &high_slope);
            q->soft_weight[at] = low + high;
            q->soft_slope[at] = high_slope - low_slope - (low + high) * x;
        }
}

/* Where everything stands, by the interior point's rooms and prices. */
static void mpc_qp_identify(mpc_ctx *c, int soft) {
    mpc_qp *q = &c->qp;
    int at, i;
    q->is_interior = q->has_limits = 0;
    for (at = 0; at < MPC_ROWS_SOFT; at++) {
        const mpc_pair *pair = q->pair + QP_LIMITS + 4 * at;
        for (i = 0, q->touch[at] = 0; i < 2 && soft; i++, pair += 2)
            if (pair[0].room < HUGE_VAL && pair[0].price > pair[0].room) {
                q->touch[at] = (signed char)((i ? 1 : -1) * (pair[1].room > pair[1].price ? 2 : 1));
                q->touch_price[at] = pair[0].price;
            }
    }
    for (at = 0; at < MPC_N_Z; at++) {
        const mpc_pair *pair = q->pair + 2 * at;
        q->side[at] = pair[0].price > pair[0].room   ? QP_AT_LOWER
                      : pair[1].price > pair[1].room ? QP_AT_UPPER
                                                     : QP_FREE;
#if MPC_RATES_LIMITED
        pair += QP_MOVES;
        q->fast[at] = pair[0].price > pair[0].room ? -1 : pair[1].price > pair[1].room;
        if (!q->side[at]) {
            q->side[at] = (signed char)(2 * q->fast[at]);
            q->fast[at] = 0;
        }
#endif
    }
}

/* The recursion has barriers in place of sides. */
static void mpc_qp_enter(mpc_ctx *c, int soft) {
    mpc_qp *q = &c->qp;
    memset(q->side, 0, sizeof q->side);
    q->is_interior = 1;
    q->has_limits = soft;
    q->n_on = 0;
    q->width = (QP_PRICES + MPC_N_TERMINAL + 3) / 4 * 4;
    memset(q->touch, 0, sizeof q->touch);
#if MPC_RATES_LIMITED
    memset(q->fast, 0, sizeof q->fast);
#endif
}

/* The primal-dual interior point; `inside` is its answer, unless the sides that it leads to are
 * right (`solved`) before it ends. Whether it came to an end. */
static int mpc_qp_interior(mpc_ctx *c, int soft, int *solved) {
    mpc_qp *q = &c->qp;
    const int pairs = soft ? MPC_QP_PAIRS : QP_LIMITS;
    double mu = HUGE_VAL, sigma = 0.1, tried = QP_GAP_TRIED;
    int round, at, i, k, ignored;
    *solved = 0;
    mpc_qp_begin_inside(c, soft);
    mpc_qp_enter(c, soft);
    for (round = 0; round < MPC_INTERIOR_ROUNDS; round++) {
        double primal = 1, dual = 1, sum = 0;
        int count = 0;
        for (i = 0; i < pairs; i++) {
            if (!(q->pair[i].room < HUGE_VAL) || q->pair[i].price == 0) continue;
            sum += q->pair[i].room * q->pair[i].price;
            count++;
        }
        mu = sum / count;
        if (!(mu > QP_GAP)) break;
        if (mu < tried) {
            tried = QP_GAP_AGAIN * mu;
            mpc_qp_identify(c, soft);
            if (mpc_qp_pivot(c, MPC_TRIAL_ROUNDS, 1)) {
                *solved = 1;
                return 1;
            }
            mpc_qp_enter(c, soft);
            mpc_qp_simulate(c, q->inside);
        }
        mpc_qp_weigh(c, soft, sigma * mu);
        memcpy(q->dx_before, q->dx, sizeof q->dx);
        if (!mpc_qp_sweep(c, MPC_N - 1) || !mpc_qp_prices(c)) break;
        mpc_qp_forward(c, &ignored);
        for (at = 0; at < MPC_N_Z; at++) {
            const double d = q->dz[at] - q->inside[at];
            mpc_qp_follow(q->pair + 2 * at, d, sigma * mu);
#if MPC_RATES_LIMITED
            if (mpc_rate_limited[at % MPC_N_U])
                mpc_qp_follow(
                    q->pair + QP_MOVES + 2 * at,
                    d - (at < MPC_N_U ? 0 : q->dz[at - MPC_N_U] - q->inside[at - MPC_N_U]),
                    sigma * mu);
#endif
        }
        for (k = 0; k < MPC_N && soft; k++)
            for (i = 0; i < MPC_N_LIMITED; i++) {
                const int row = mpc_limited_row[i];
                const double d = q->dx[k + 1][row] - q->dx_before[k + 1][row];
                mpc_pair *pair = q->pair + QP_LIMITS + 4 * (k * MPC_N_LIMITED + i);
                mpc_qp_follow_soft(c, pair, pair + 1, -d, sigma * mu);
                mpc_qp_follow_soft(c, pair + 2, pair + 3, d, sigma * mu);
            }
        for (i = 0; i < pairs; i++) {
            const mpc_pair *pair = q->pair + i;
            if (!(pair->room < HUGE_VAL) || pair->price == 0) continue;
            if (pair->d_room < 0 && -QP_INSIDE * pair->room > pair->d_room * primal)
                primal = -QP_INSIDE * pair->room / pair->d_room;
            if (pair->d_price < 0 && -QP_INSIDE * pair->price > pair->d_price * dual)
                dual = -QP_INSIDE * pair->price / pair->d_price;
        }
        if (soft) primal = dual = primal < dual ? primal : dual; /* violations tie both */
        if (!(primal > 0)) break;
        for (at = 0; at < MPC_N_Z; at++) q->inside[at] += primal * (q->dz[at] - q->inside[at]);
        for (k = 1; k <= MPC_N; k++)
            for (i = 0; i < MPC_N_FULL; i++)
                q->dx[k][i] = q->dx_before[k][i] + primal * (q->dx[k][i] - q->dx_before[k][i]);
        for (i = 0; i < pairs; i++) {
            q->pair[i].room += primal * q->pair[i].d_room;
            q->pair[i].price += dual * q->pair[i].d_price;
        }
        sigma = primal > 0.9 && dual > 0.9 ? 0.01 : primal > 0.5 && dual > 0.5 ? 0.1 : 0.3;
    }
    mpc_qp_identify(c, soft);
    return mu < (soft ? 1e-5 : 1e-9);
}

/* The solution `dz` of the QP around the plan, and the states `dx` that it leads to; whether there
 * is one. */
static int mpc_qp_solve(mpc_ctx *c) {
    const mpc_settings *s = &c->settings;
    mpc_qp *q = &c->qp;
    int at;
    for (at = 0; at < MPC_N_Z; at++) {
        const int j = at % MPC_N_U;
        q->side[at] = c->plan[at] <= s->lower[j] + QP_TOLERANCE   ? QP_AT_LOWER
                      : c->plan[at] >= s->upper[j] - QP_TOLERANCE ? QP_AT_UPPER
                                                                  : QP_FREE;
    }
    q->is_interior = q->has_limits = q->is_capped = 0;
#if MPC_RATES_LIMITED
    memset(q->fast, 0, sizeof q->fast);
#endif
    if (!mpc_qp_pivot(c, MPC_ROUNDS, 1)) {
        int solved;
        if (!mpc_qp_interior(c, MPC_N_LIMITED > 0, &solved)) return 0;
        if (!solved && !mpc_qp_pivot(c, MPC_LAST_ROUNDS, 0)) { /* as near as the point inside came */
            q->is_capped = 1;
            memcpy(q->dz, q->inside, sizeof q->dz);
            mpc_qp_simulate(c, q->dz);
            memset(q->touch, 0, sizeof q->touch); /* no good start for the next */
        }
    }
    return mpc_finite(q->dz, MPC_N_Z);
}

/* The step's curvature dz' H dz, and the largest component of H dz: that of the Lagrangian's
 * gradient before the step. */
static double mpc_qp_curvature(const mpc_ctx *c, double *largest) {
    const mpc_settings *s = &c->settings;
    const mpc_qp *q = &c->qp;
    double gradient[MPC_N_Z] = {0}, a[MPC_N_FULL] = {0}, curvature = 0;
    int k, i, j, at;
    for (i = 0; i < MPC_N_WEIGHTED; i++)
        a[mpc_weighted_row[i]] += 2 * s->state_weights[i] * q->dx[MPC_N][mpc_weighted_row[i]];
#if MPC_END_COST
    if (mpc_has_end_cost(c)) {
        double xi[MPC_N_V], image[MPC_N_V];
        for (i = 0; i < MPC_N_V; i++)
            xi[i] = i < MPC_N_FULL ? q->dx[MPC_N][i] : q->dz[MPC_N_Z - MPC_N_V + i];
        for (i = 0; i < MPC_N_V; i++)
            for (j = i, image[i] = 0; j < MPC_N_V; j++) image[i] += c->region.root[i][j] * xi[j];
        for (i = 0; i < MPC_N_V; i++) {
            double sum = 0;
            for (j = 0; j <= i; j++) sum += 2 * c->region.root[j][i] * image[j];
            if (i < MPC_N_FULL) a[i] += sum;
            else gradient[MPC_N_Z - MPC_N_V + i] += sum;
        }
    }
#endif
    for (k = MPC_N - 1; k >= 0; k--) {
        double before[MPC_N_FULL] = {0};
        const double *u = q->dz + mpc_block[k] * MPC_N_U;
        for (i = 0; i < MPC_N_DAMPED; i++) {
            const int row = mpc_damped_row[i];
            const double e = 2 * s->rate_weights[i] * (q->dx[k + 1][row] - q->dx[k][row]) /
                             (MPC_PERIOD * MPC_PERIOD);
            a[row] += e;
            before[row] -= e;
        }
        if (k)
            for (i = 0; i < MPC_N_WEIGHTED; i++)
                before[mpc_weighted_row[i]] +=
                    2 * s->state_weights[i] * q->dx[k][mpc_weighted_row[i]];
        for (j = 0; j < MPC_N_U; j++) {
            double sum = 2 * s->input_weights[j] * u[j];
            for (i = 0; i < MPC_N_FULL; i++) sum += q->F[k][i][MPC_N_FULL + j] * a[i];
            gradient[mpc_block[k] * MPC_N_U + j] += sum;
        }
        for (i = 0; i < MPC_N_FULL; i++) {
            const double of = a[i];
            for (j = 0; j < MPC_N_FULL; j++) before[j] += of * q->F[k][i][j];
        }
        memcpy(a, before, sizeof a);
    }
    for (at = 0; at < MPC_N_Z; at++) {
        const int j = at % MPC_N_U;
        const double move = q->dz[at] - (at < MPC_N_U ? 0 : q->dz[at - MPC_N_U]);
        gradient[at] += 2 * s->move_weights[j] * move + MPC_REGULARISATION * q->dz[at];
        if (at >= MPC_N_U) gradient[at - MPC_N_U] -= 2 * s->move_weights[j] * move;
    }
    for (at = 0; at < MPC_N_Z; at++) curvature += q->dz[at] * gradient[at];
    *largest = mpc_largest(gradient, MPC_N_Z);
    return curvature;
}
