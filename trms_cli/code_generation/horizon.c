/* ------------------------------------------------------------------------------------------
 * The horizon: the trajectory of a plan, its cost, and the quadratic model of the cost.
 *
 *     J(z)   = sum_k sum_i q_i e_ik^2 + sum_k sum_c d_c ((a_c,k - a_c,k-1)/T - rate_c,k)^2
 *              + sum_k sum_j rho_j (u_jk - u_s,j)^2 + sum_b sum_j s_j (z_jb - z_j,b-1)^2
 *     phi(z) = J(z) + sum_c (mu_c |v_c| + nu_c v_c^2)
 *
 * with rate that of a reference that moves smoothly and v the scaled miss of the terminal steady state and the violations of soft limits.
 * ------------------------------------------------------------------------------------------ */

#define MPC_REGULARISATION 1e-6 /* 1/V^2: inputs without influence stay where they are */
#define MPC_N_ERRORS (MPC_N_WEIGHTED + MPC_N_DAMPED)

typedef struct {
    double objective, merit, violation, terminal_residual;
    double terminal[MPC_N_X];
} mpc_cost;

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

/* The same with its slopes (column after column) in x and u. */
static void mpc_advance_with_slopes(mpc_ctx *c, const double *x, const double *u) {
    const double *arguments[MPC_ROOM(MPC_SLOPES_ARG)];
    double *results[MPC_ROOM(MPC_SLOPES_RES)];
    arguments[0] = x;
    arguments[1] = u;
    arguments[2] = c->settings.p;
    arguments[3] = c->w;
    results[0] = c->stage_next;
    results[1] = c->stage_a;
    results[2] = c->stage_b;
    mpc_model_slopes(arguments, results, c->iw, c->work, 0);
}

/* The rates at which the references move, as far as they move smoothly. */
static void mpc_find_rates(mpc_ctx *c) {
    const double *arguments[MPC_ROOM(MPC_RATES_ARG)];
    double *results[MPC_ROOM(MPC_RATES_RES)];
    arguments[0] = c->reference;
    results[0] = c->rates;
    mpc_reference_rates(arguments, results, c->iw, c->work, 0);
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
    for (i = 0; i < MPC_N_TERMINAL; i++) {
        const double x = c->trajectory[(MPC_N - 1) * MPC_N_FULL + i];
        const double miss = (x - c->target.x[i]) / s->scale[i];
        cost->terminal[i] = miss;
        absolute += fabs(miss);
        squares += miss * miss;
        if (fabs(miss) > cost->terminal_residual) cost->terminal_residual = fabs(miss);
    }
    if (MPC_N_TERMINAL) cost->merit += s->terminal_linear * absolute + s->terminal_quadratic * squares;
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
        mpc_advance(c, x, z + mpc_block[k] * MPC_N_U, c->w, c->trajectory + k * MPC_N_FULL);
        x = c->trajectory + k * MPC_N_FULL;
    }
    mpc_cost_of(c, z, cost);
}

/* The slopes of the state after period k in the plan, of which `width` columns have begun. */
static void mpc_propagate(mpc_ctx *c, int k, int width, const double *restrict before,
                          double *restrict after) {
    const int old = k == 0 ? 0 : (mpc_block[k - 1] + 1) * MPC_N_U;
    const int present = mpc_block[k] * MPC_N_U;
    int i, j, col;
    for (i = 0; i < MPC_N_FULL; i++) {
        double *restrict to = after + i * MPC_N_Z;
        for (col = 0; col < width; col++) to[col] = 0;
        for (j = 0; j < MPC_N_FULL; j++) {
            const double a = c->stage_a[j * MPC_N_FULL + i];
            const double *restrict from = before + j * MPC_N_Z;
            if (a == 0) continue;
            for (col = 0; col < old; col++) to[col] += a * from[col];
        }
        for (j = 0; j < MPC_N_U; j++) to[present + j] += c->stage_b[j * MPC_N_FULL + i];
    }
}

/* Add one period's errors to the lower triangle of the Hessian and to the gradient. */
static void mpc_add_errors(mpc_ctx *c, int k, int width, const double *restrict slopes,
                           const double *now, const double *before) {
    const mpc_settings *s = &c->settings;
    double values[MPC_ROOM(MPC_N_ERRORS)];
    double *restrict errors = c->errors;
    int i, a, b;
    for (i = 0; i < MPC_N_WEIGHTED; i++) {
        const int row = mpc_weighted_row[i], ref = mpc_weighted_reference[i];
        const double root = sqrt(s->state_weights[i]);
        const double goal = ref < 0 ? c->target.x[row] : c->reference[k * MPC_N_R + ref];
        values[i] = root * (now[row] - goal);
        for (a = 0; a < width; a++) errors[i * MPC_N_Z + a] = root * slopes[row * MPC_N_Z + a];
    }
    for (i = 0; i < MPC_N_DAMPED; i++) {
        const int row = mpc_damped_row[i], e = MPC_N_WEIGHTED + i;
        const double root = sqrt(s->rate_weights[i]);
        double *last = c->damped_before + i * MPC_N_Z;
        values[e] = root * ((now[row] - before[row]) / MPC_PERIOD -
                            c->rates[k * MPC_N_R + mpc_damped_reference[i]]);
        for (a = 0; a < width; a++) {
            const double slope = slopes[row * MPC_N_Z + a];
            errors[e * MPC_N_Z + a] = root * ((slope - last[a]) / MPC_PERIOD);
            last[a] = slope;
        }
    }
    for (a = 0; a < width; a++) {
        double *restrict to = c->hessian + a * MPC_N_Z;
        double factors[MPC_ROOM(MPC_N_ERRORS)], sum = 0;
        for (i = 0; i < MPC_N_ERRORS; i++) {
            factors[i] = 2 * errors[i * MPC_N_Z + a];
            sum += factors[i] * values[i];
        }
        c->gradient[a] += sum;
        for (b = 0; b <= a; b++) {
            double entry = 0;
            for (i = 0; i < MPC_N_ERRORS; i++) entry += factors[i] * errors[i * MPC_N_Z + b];
            to[b] += entry;
        }
    }
}

/* Trajectory, cost, gradient and Hessian (lower triangle) of J, and the rows of the QP that
 * depend on the trajectory. */
static void mpc_linearise(mpc_ctx *c, const double *z, mpc_cost *cost) {
    const mpc_settings *s = &c->settings;
    const double *x = c->full;
    double *slopes = c->sensitivity[0], *other = c->sensitivity[1];
    int i, j, k, b, col;
    memset(c->hessian, 0, sizeof c->hessian);
    memset(c->damped_before, 0, sizeof c->damped_before);
    for (b = 0; b < MPC_N_BLOCKS; b++)
        for (j = 0; j < MPC_N_U; j++) {
            const int at = b * MPC_N_U + j;
            const double rho = s->input_weights[j] * mpc_periods[b], move = s->move_weights[j];
            const double off = z[at] - c->target.u[j];
            const double since = z[at] - (b ? z[at - MPC_N_U] : c->last_u[j]);
            double gradient = 2 * (rho * off + move * since), curvature = rho + move;
            if (b + 1 < MPC_N_BLOCKS) {
                gradient -= 2 * move * (z[at + MPC_N_U] - z[at]);
                curvature += move;
            }
            c->gradient[at] = gradient;
            c->hessian[at * MPC_N_Z + at] = 2 * curvature + MPC_REGULARISATION;
            if (b) c->hessian[at * MPC_N_Z + at - MPC_N_U] = -2 * move;
        }
    for (k = 0; k < MPC_N; k++) {
        const int width = (mpc_block[k] + 1) * MPC_N_U;
        double *swap = slopes, *now = c->trajectory + k * MPC_N_FULL;
        mpc_advance_with_slopes(c, x, z + mpc_block[k] * MPC_N_U);
        memcpy(now, c->stage_next, sizeof c->stage_next);
        slopes = other;
        other = swap;
        mpc_propagate(c, k, width, other, slopes);
        mpc_add_errors(c, k, width, slopes, now, x);
        for (i = 0; i < MPC_N_LIMITED; i++) {
            double *row = c->rows + (MPC_ROWS + k * MPC_N_LIMITED + i) * MPC_N_Z;
            const double *from = slopes + mpc_limited_row[i] * MPC_N_Z;
            for (col = 0; col < MPC_N_Z; col++) row[col] = col < width ? from[col] : 0;
        }
        x = now;
    }
    for (i = 0; i < MPC_N_TERMINAL; i++)
        for (col = 0; col < MPC_N_Z; col++)
            c->rows[i * MPC_N_Z + col] = slopes[i * MPC_N_Z + col] / s->scale[i];
    mpc_cost_of(c, z, cost);
}
