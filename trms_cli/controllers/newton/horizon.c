/* ------------------------------------------------------------------------------------------
 * The horizon: the trajectory of a plan, its cost, and the quadratic model of the cost.
 *
 *     J(z)   = sum_k sum_i q_i e_ik^2 + sum_k sum_c d_c ((a_c,k - a_c,k-1)/T - rate_c,k)^2
 *              + sum_k sum_j rho_j (u_jk - u_s,j)^2 + sum_b sum_j s_j (z_jb - z_j,b-1)^2
 *     phi(z) = J(z) + sum_c (mu_c |v_c| + nu_c v_c^2)
 *
 * with rate that of a reference that moves smoothly and v the scaled miss of the terminal steady
 * state and the violations of soft limits. A terminal region has a cost |L xi|^2 of its own, and v
 * is how far |L xi| is beyond its radius. A linear model may have such a cost without a region; its
 * rates are not compared with those of the reference.
 * ------------------------------------------------------------------------------------------ */

#define MPC_REGULARISATION (MPC_LINEAR ? 1e-9 : 1e-6) /* 1/V^2, for inputs without influence */

#define MPC_SMOOTH 1e-20 /* under the root of |L xi|^2, whose slope is no number at 0 */

typedef struct {
    double objective, merit, violation, terminal_residual;
    double terminal[MPC_ROOM(MPC_N_TERMINAL)];
} mpc_cost;

/* Whether the horizon ends in a region around the target. */
static int mpc_in_region(const mpc_ctx *c) {
#if MPC_REGION
    return c->region.holds;
#else
    (void)c;
    return 0;
#endif
}

/* Whether where it ends has a cost of its own. */
static int mpc_has_end_cost(const mpc_ctx *c) { return MPC_REGION ? mpc_in_region(c) : MPC_END_COST; }

static double mpc_clipped(double value, double lower, double upper) {
    return value < lower ? lower : value > upper ? upper : value;
}

static int mpc_finite(const double *values, int n) {
    int i;
    for (i = 0; i < n; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

static double mpc_largest(const double *values, int n) {
    double largest = 0;
    int i;
    for (i = 0; i < n; i++)
        if (fabs(values[i]) > largest) largest = fabs(values[i]);
    return largest;
}

/* The model over one control period: (x, u, p, w) -> x_next. */
static void mpc_advance(mpc_ctx *c, const double *x, const double *u, const double *w,
                        double *next) {
    const double *arguments[MPC_ROOM(MPC_STEP_ARG)];
    double *results[MPC_ROOM(MPC_STEP_RES)];
    arguments[0] = x;
    arguments[1] = u;
    arguments[2] = c->settings.p;
    arguments[3] = w;
    results[0] = next;
    mpc_model_step(arguments, results, c->iw, c->work, 0);
}

/* What is remembered of past commands, as after a long time at one: a state's last entries. */
static void mpc_settle_memory(mpc_ctx *c, double *full, const double *u, int most) {
    static const double still[MPC_ROOM(MPC_N_W)] = {0};
    int i, k, settled = MPC_N_FULL == MPC_N_X;
    for (k = 0; k < most && !settled; k++) {
        mpc_advance(c, full, u, still, c->stage_next);
        settled = 1;
        for (i = MPC_N_X; i < MPC_N_FULL; i++) {
            if (c->stage_next[i] != full[i]) settled = 0;
            full[i] = c->stage_next[i];
        }
    }
}

/* The same under the present torques, with its slopes in (x, u). */
static void mpc_advance_with_slopes(mpc_ctx *c, const double *x, const double *u, double *next,
                                    double (*F)[MPC_N_F]) {
    const double *arguments[MPC_ROOM(MPC_SLOPES_ARG)];
    double *results[MPC_ROOM(MPC_SLOPES_RES)];
    arguments[0] = x;
    arguments[1] = u;
    arguments[2] = c->settings.p;
    arguments[3] = c->w;
    results[0] = next;
    results[1] = F[0];
    mpc_model_slopes(arguments, results, c->iw, c->work, 0);
}

#if MPC_LINEAR
static void mpc_predict_linear(const mpc_linear *model, const double *x, const double *u,
                               double *next) {
    int i, j;
    for (i = 0; i < MPC_N_FULL; i++) {
        double sum = model->drift[i];
        for (j = 0; j < MPC_N_FULL; j++) sum += model->F[i][j] * x[j];
        for (j = 0; j < MPC_N_U; j++) sum += model->F[i][MPC_N_FULL + j] * u[j];
        next[i] = sum;
    }
}
#else
/* The rates at which the references move, as far as they move smoothly. */
static void mpc_find_rates(mpc_ctx *c) {
    const double *arguments[MPC_ROOM(MPC_RATES_ARG)];
    double *results[MPC_ROOM(MPC_RATES_RES)];
    arguments[0] = c->reference;
    results[0] = c->rates;
    mpc_reference_rates(arguments, results, c->iw, c->work, 0);
}
#endif

/* The state that is predicted after a period. */
static void mpc_predict(mpc_ctx *c, const double *x, const double *u, double *next) {
#if MPC_LINEAR
    mpc_predict_linear(&c->model, x, u, next);
#else
    mpc_advance(c, x, u, c->w, next);
#endif
}

/* The cost of a plan whose trajectory is there. */
static void mpc_cost_of(const mpc_ctx *c, const double *z, mpc_cost *cost) {
    const mpc_settings *s = &c->settings;
    int i, j, k, b;
    double objective = 0, inputs = 0, moves = 0, absolute = 0, squares = 0;
    for (i = 0; i < MPC_N_WEIGHTED; i++) {
        const int row = mpc_weighted_row[i], ref = mpc_weighted_reference[i];
        double sum = 0;
        for (k = 0; k < MPC_N; k++) {
            const double goal = ref < 0 ? c->target.x[row] : c->reference[k * MPC_N_R + ref];
            const double error = c->trajectory[k * MPC_N_FULL + row] - goal;
            sum += error * error;
        }
        objective += s->state_weights[i] * sum;
    }
    for (i = 0; i < MPC_N_DAMPED; i++) {
        const int row = mpc_damped_row[i];
        double sum = 0, before = c->full[row];
        for (k = 0; k < MPC_N; k++) {
            const double rate = (c->trajectory[k * MPC_N_FULL + row] - before) / MPC_PERIOD;
            const double off = rate - c->rates[k * MPC_N_R + mpc_damped_reference[i]];
            before = c->trajectory[k * MPC_N_FULL + row];
            sum += off * off;
        }
        objective += s->rate_weights[i] * sum;
    }
    for (b = 0; b < MPC_N_BLOCKS; b++)
        for (j = 0; j < MPC_N_U; j++) {
            const double u = z[b * MPC_N_U + j], off = u - c->target.u[j];
            const double move = u - (b ? z[(b - 1) * MPC_N_U + j] : c->last_u[j]);
            inputs += s->input_weights[j] * mpc_periods[b] * off * off;
            moves += s->move_weights[j] * move * move;
        }
    cost->objective = objective + (inputs + moves);
    cost->merit = cost->objective;
    cost->violation = 0;
    cost->terminal_residual = 0;
    memset(cost->terminal, 0, sizeof cost->terminal);
    if (mpc_has_end_cost(c)) {
#if MPC_END_COST
        const double *last = c->trajectory + (MPC_N - 1) * MPC_N_FULL;
        double length = 0;
        for (i = 0; i < MPC_N_V; i++) {
            double sum = 0;
            for (j = i; j < MPC_N_V; j++)
                sum += c->region.root[i][j] *
                       ((j < MPC_N_FULL ? last[j] : z[MPC_N_Z - MPC_N_V + j]) -
                        c->region.centre[j]);
            length += sum * sum;
        }
        cost->merit = cost->objective += length;
#endif
#if MPC_REGION
        cost->terminal[0] = sqrt(length + MPC_SMOOTH) - c->region.radius;
        cost->terminal_residual = cost->terminal[0] > 0 ? cost->terminal[0] : 0;
        cost->merit += s->terminal_linear * cost->terminal_residual +
                       s->terminal_quadratic * cost->terminal_residual * cost->terminal_residual;
#endif
    }
    for (i = 0; i < MPC_N_TERMINAL && !mpc_in_region(c); i++) {
        const double x = c->trajectory[(MPC_N - 1) * MPC_N_FULL + i];
        const double miss = (x - c->target.x[i]) / s->scale[i];
        cost->terminal[i] = miss;
        absolute += fabs(miss);
        squares += miss * miss;
        if (fabs(miss) > cost->terminal_residual) cost->terminal_residual = fabs(miss);
    }
    if (MPC_N_TERMINAL && !mpc_in_region(c))
        cost->merit += s->terminal_linear * absolute + s->terminal_quadratic * squares;
    for (i = 0; i < MPC_N_LIMITED; i++) {
        const double lower = s->soft_limits[i][0], upper = s->soft_limits[i][1];
        absolute = squares = 0;
        for (k = 0; k < MPC_N; k++) {
            const double value = c->trajectory[k * MPC_N_FULL + mpc_limited_row[i]];
            double beyond = lower - value > value - upper ? lower - value : value - upper;
            if (!(beyond > 0)) continue;
            absolute += beyond;
            squares += beyond * beyond;
            if (beyond > cost->violation) cost->violation = beyond;
        }
        cost->merit += s->soft_linear * absolute + s->soft_quadratic * squares;
    }
}

/* Trajectory and cost of a plan. */
static void mpc_evaluate(mpc_ctx *c, const double *z, mpc_cost *cost) {
    const double *x = c->full;
    int k;
    for (k = 0; k < MPC_N; k++) {
        mpc_predict(c, x, z + mpc_block[k] * MPC_N_U, c->trajectory + k * MPC_N_FULL);
        x = c->trajectory + k * MPC_N_FULL;
    }
    mpc_cost_of(c, z, cost);
}

/* Trajectory and cost of a plan, and the model's slopes along it. */
static void mpc_linearise(mpc_ctx *c, const double *z, mpc_cost *cost) {
#if MPC_LINEAR
    int k;
    for (k = 0; k < MPC_N; k++) memcpy(c->qp.F[k], c->model.F, sizeof c->model.F);
    mpc_evaluate(c, z, cost);
#else
    const double *x = c->full;
    int k;
    for (k = 0; k < MPC_N; k++) {
        double *next = c->trajectory + k * MPC_N_FULL;
        mpc_advance_with_slopes(c, x, z + mpc_block[k] * MPC_N_U, next, c->qp.F[k]);
        x = next;
    }
    mpc_cost_of(c, z, cost);
#endif
    memcpy(c->qp.miss, cost->terminal, sizeof cost->terminal);
}
