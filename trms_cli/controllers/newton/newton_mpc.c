/* ------------------------------------------------------------------------------------------
 * The controller: Newton iterations over the whole horizon, each a quadratic program and a line
 * search on phi, from the last plan shifted in time; one iteration a sample is the real-time
 * iteration.
 * ------------------------------------------------------------------------------------------ */

#define MPC_ARMIJO 1e-4
#define MPC_DOUBT 0.8     /* exponent of what is known of the convergence, from sample to sample */
#define MPC_LEAST_SHARE 0.01 /* that a step is believed to leave: a plan against its bounds leaves none */
#define MPC_EXPECTED 0.1 /* share of the tolerance that a converged plan is expected to be off */
#define MPC_RELAXED_ABOVE 1e-3
static const double mpc_step_lengths[] = {1.0, 0.5, 0.25, 0.1, 0.03, 0.01};

/* Seconds from any moment; a program that has a clock defines it before this source. */
#ifndef MPC_CLOCK
#define MPC_CLOCK() 0.0
#endif
#define MPC_STUCK 0.02 /* share of the way to the steady input that a step goes at least */

typedef struct {
    mpc_reason failed;
    int iterations, converged, stalled, is_stuck;
    double objective, merit, violation, terminal_residual, kkt_residual;
    double move; /* largest of the last step, V; 0 where there was none, or a shortened one */
} mpc_outcome;

static void mpc_report(const mpc_cost *cost, mpc_outcome *outcome) {
    outcome->objective = cost->objective;
    outcome->merit = cost->merit;
    outcome->violation = cost->violation;
    outcome->terminal_residual = cost->terminal_residual;
}

#if MPC_RATES_LIMITED
/* Bring the plan within the rate limits, block after block from the last command. */
static void mpc_limit_rates(mpc_ctx *c) {
    int at;
    for (at = 0; at < MPC_N_Z; at++) {
        const int j = at % MPC_N_U;
        const double before = at < MPC_N_U ? c->last_u[j] : c->plan[at - MPC_N_U];
        const double most = c->settings.largest_moves[j];
        if (mpc_rate_limited[j]) c->plan[at] = mpc_clipped(c->plan[at], before - most, before + most);
    }
}
#endif

/* Along the Newton direction until phi falls (Armijo); else stay. The share that was gone. */
static double mpc_move(mpc_ctx *c, const double *step, double curvature, const mpc_cost *present,
                     mpc_outcome *outcome) {
    const double slack = 1e-12 * (1.0 + fabs(present->merit));
    mpc_cost cost;
    int i, k;
    for (k = 0; k < (int)(sizeof mpc_step_lengths / sizeof mpc_step_lengths[0]); k++) {
        const double length = mpc_step_lengths[k];
        for (i = 0; i < MPC_N_Z; i++) c->trial[i] = c->plan[i] + length * step[i];
        mpc_evaluate(c, c->trial, &cost);
        if (cost.merit <= present->merit - MPC_ARMIJO * length * curvature + slack) {
            /* Rounding may leave a bound by a hair. */
            for (i = 0; i < MPC_N_Z; i++)
                c->plan[i] = mpc_clipped(c->trial[i], c->settings.lower[i % MPC_N_U],
                                         c->settings.upper[i % MPC_N_U]);
            mpc_report(&cost, outcome);
            return length;
        }
    }
    outcome->stalled = !outcome->converged;
    mpc_evaluate(c, c->plan, &cost); /* the trajectory is the last trial's */
    mpc_report(present, outcome);
    return 0;
}

/* Whether what is left after a full step of this size is negligible: steps that shrink by theta
 * leave theta / (1 - theta) of the last one. The first step of a sample has no theta yet; that of
 * the last sample stands in, believed a little less each time (Hairer & Wanner, Solving ODEs II,
 * IV.8). `before` is 0 for a first step. */
static int mpc_is_last(mpc_ctx *c, double before, double now) {
    if (before > 0) c->remaining_share = now < before ? now / (before - now) : HUGE_VAL;
    return now * c->remaining_share <= MPC_EXPECTED * c->settings.tolerance;
}

/* Whether a step leaves an input all but where it is, far from that of the steady state: a rotor
 * at rest has no thrust slope, so that the linearisation sees no use in it. */
static int mpc_is_stuck(const mpc_ctx *c) {
    int at, j;
    for (j = 0; j < MPC_N_U; j++) {
        double way = 0, moved = 0;
        for (at = j; at < MPC_N_Z; at += MPC_N_U) {
            const double off = fabs(c->plan[at] - c->target.u[j]), move = fabs(c->qp.dz[at]);
            if (off > way) way = off;
            if (move > moved) moved = move;
        }
        if (way > c->settings.tolerance && moved < MPC_STUCK * way) return 1;
    }
    return 0;
}

static void mpc_iterate(mpc_ctx *c, mpc_outcome *outcome) {
    mpc_cost cost;
    double curvature, largest, begin = MPC_CLOCK(), middle;
    int solved, is_full;
    mpc_linearise(c, c->plan, &cost);
    middle = MPC_CLOCK();
    c->linearise_seconds += middle - begin;
    if (!(cost.merit < HUGE_VAL)) {
        outcome->failed = MPC_DIVERGED;
        return;
    }
    solved = mpc_qp_solve(c);
    c->qp_seconds += MPC_CLOCK() - middle;
    if (!solved) {
        outcome->failed = MPC_PROGRAM_UNSOLVED;
        return;
    }
    if (outcome->iterations == 1) outcome->is_stuck = mpc_is_stuck(c);
    curvature = mpc_qp_curvature(c, &outcome->kkt_residual);
    largest = mpc_largest(c->qp.dz, MPC_N_Z);
    outcome->converged = largest <= c->settings.tolerance;
    is_full = mpc_move(c, c->qp.dz, curvature, &cost, outcome) >= 1;
    if (!is_full) c->remaining_share = HUGE_VAL;
    else if (mpc_is_last(c, outcome->move, largest)) outcome->converged = 1;
    outcome->move = is_full ? largest : 0;
}

/* Iterate from the present plan, which never gets worse in phi. */
static void mpc_solve_from(mpc_ctx *c, mpc_outcome *outcome) {
    memset(outcome, 0, sizeof *outcome);
    c->remaining_share = pow(fmax(c->remaining_share, MPC_LEAST_SHARE), MPC_DOUBT);
#if MPC_RATES_LIMITED
    mpc_limit_rates(c);
#endif
    while (outcome->iterations < c->settings.max_iterations) {
        outcome->iterations++;
        mpc_iterate(c, outcome);
        if (outcome->failed || outcome->converged || outcome->stalled) return;
    }
}

static void mpc_hold_everywhere(const double *u, double *plan) {
    int at;
    for (at = 0; at < MPC_N_Z; at++) plan[at] = u[at % MPC_N_U];
}

/* Iterate from the plan and, where the reference has changed and the plan sees no way to it, from
 * the steady input too. */
static void mpc_solve(mpc_ctx *c, int is_new, mpc_outcome *outcome) {
    mpc_outcome second;
    mpc_cost cost;
    mpc_solve_from(c, outcome);
    if (!is_new || !(outcome->failed || outcome->is_stuck)) return;
    memcpy(c->plan_kept, c->plan, sizeof c->plan);
    mpc_hold_everywhere(c->target.u, c->plan);
    mpc_solve_from(c, &second);
    if (second.failed || (second.merit >= outcome->merit && !outcome->failed)) {
        memcpy(c->plan, c->plan_kept, sizeof c->plan);
        mpc_evaluate(c, c->plan, &cost);
        outcome->iterations += second.iterations;
        return;
    }
    second.iterations += outcome->iterations;
    *outcome = second;
}

/* The plan one control period later: its mean over each block, an input beyond its end. */
static void mpc_shift_plan(mpc_ctx *c, const double *beyond) {
    int k, j, at;
    memset(c->trial, 0, sizeof c->trial);
    for (k = 0; k < MPC_N; k++)
        for (j = 0; j < MPC_N_U; j++)
            c->trial[mpc_block[k] * MPC_N_U + j] +=
                k + 1 < MPC_N ? c->plan[mpc_block[k + 1] * MPC_N_U + j] : beyond[j];
    for (at = 0; at < MPC_N_Z; at++) c->plan[at] = c->trial[at] / mpc_periods[at / MPC_N_U];
}

/* The steady state of a reference under the present torques; the last one if there is none. Whether
 * it is another. */
static int mpc_find_target(mpc_ctx *c, const double *goal) {
    double given[MPC_N_R + MPC_N_W + MPC_N_PATHS];
    const int n_given = MPC_N_R + MPC_N_W + MPC_N_PATHS;
    mpc_target found;
    int i;
    memset(&found, 0, sizeof found);
    for (i = 0; i < MPC_N_R; i++) given[i] = goal[i];
    for (i = 0; i < MPC_N_W; i++) given[MPC_N_R + i] = c->w[i];
    for (i = 0; i < MPC_N_PATHS; i++)
        given[MPC_N_R + MPC_N_W + i] = c->full[mpc_memory_row[i]];
    if (c->has_target && c->solved_for_valid) {
        for (i = 0; i < n_given && given[i] == c->solved_for[i]; i++) continue;
        if (i == n_given) return 0;
    }
    mpc_ss_solve(c, goal, c->w, c->has_target ? &c->target : NULL, &found);
    c->target_is_held = found.converged || !c->has_target;
    c->solved_for_valid = found.converged;
    memcpy(c->solved_for, given, sizeof given);
    if (c->target_is_held) c->target = found;
    c->has_target = 1;
    return c->target_is_held;
}

#if MPC_FORECAST
#define MPC_WINDOW 6            /* differences that have to agree with the recursion */
#define MPC_UNEXPLAINED 1e-3    /* part of their power that it may leave */
#define MPC_FASTEST 0.5         /* cosine of the fastest phase a period */
#define MPC_STILL 1e-9          /* rad, differences of a constant */

/* Carry one reference on as the constant, ramp or sine that it has been so far: differences d obey
 * d(k+1) = 2 c d(k) - d(k-1). Whether they do; `ahead` has MPC_FORECAST + 1 rows. */
static int mpc_forecast_one(mpc_ctx *c, int i, double value) {
    double *d = c->moves[i];
    double middle = 0, product = 0, left = 0, cosine, largest = 0, sum = 0, before, now, after;
    int k;
    if (c->reference_seen) {
        if (c->n_moves[i] == MPC_WINDOW) memmove(d, d + 1, (MPC_WINDOW - 1) * sizeof *d);
        else c->n_moves[i]++;
        d[c->n_moves[i] - 1] = value - c->last_reference[i];
    }
    c->last_reference[i] = value;
    for (k = 0; k <= MPC_FORECAST; k++) c->ahead[k * MPC_N_R + i] = value;
    if (c->n_moves[i] < MPC_WINDOW) return 0;
    for (k = 0; k < MPC_WINDOW; k++)
        if (fabs(d[k]) > largest) largest = fabs(d[k]);
    for (k = 1; k < MPC_WINDOW - 1; k++) {
        middle += d[k] * d[k];
        product += d[k] * (d[k - 1] + d[k + 1]);
    }
    if (largest < MPC_STILL || middle == 0) return 0;
    cosine = product / (2 * middle);
    if (cosine > 1) cosine = 1;
    for (k = 1; k < MPC_WINDOW - 1; k++) {
        const double off = d[k - 1] + d[k + 1] - 2 * cosine * d[k];
        left += off * off;
    }
    if (cosine < MPC_FASTEST || left > MPC_UNEXPLAINED * middle) return 0;
    before = d[MPC_WINDOW - 2];
    now = d[MPC_WINDOW - 1];
    for (k = 1; k <= MPC_FORECAST; k++) {
        after = 2 * cosine * now - before;
        before = now;
        now = after;
        sum += now;
        c->ahead[k * MPC_N_R + i] += sum;
    }
    return 1;
}

/* Forecasts of all references; how many periods they reach, 0 where none can be made. */
static int mpc_forecast(mpc_ctx *c, const double *reference) {
    int i, found = 0;
    for (i = 0; i < MPC_N_R; i++) found |= mpc_forecast_one(c, i, reference[i]);
    c->reference_seen = 1;
    return found ? MPC_FORECAST : 0;
}
#endif

/* Take in a sample: state, references, target, and the plan shifted in time. Whether the reference
 * has changed, unforeseen. */
static int mpc_begin(mpc_ctx *c, const double *x_hat, const double *reference) {
    const int had_target = c->has_target;
    int known = MPC_PREVIEW, foreseen = 0;
    const double *asked;
    double goal[MPC_N_R], previous[MPC_N_R];
    double beyond[MPC_N_U]; /* what the plan goes on with */
    int i, k, is_other, changed = !had_target;
    if (!c->first && MPC_N_FULL > MPC_N_X) {
        static const double still[MPC_ROOM(MPC_N_W)] = {0};
        mpc_advance(c, c->full, c->last_u, still, c->stage_next);
        for (i = MPC_N_X; i < MPC_N_FULL; i++) c->full[i] = c->stage_next[i];
    }
    for (i = 0; i < MPC_N_X; i++) c->full[i] = x_hat[i];
#if MPC_FORECAST
    known = mpc_forecast(c, reference);
    foreseen = known > 0;
    reference = c->ahead;
#endif
    asked = reference + known * MPC_N_R;
    for (k = 0; k < MPC_N; k++) {
        const int row = k < known ? k + 1 : known;
        for (i = 0; i < MPC_N_R; i++)
            c->reference[k * MPC_N_R + i] = reference[row * MPC_N_R + i];
    }
    for (i = 0; i < MPC_N_R; i++) {
        const int limit = mpc_goal_limit[i];
        /* A steady state beyond a soft limit would be fought over for ever. */
        goal[i] = limit < 0 ? asked[i]
                            : mpc_clipped(asked[i], c->settings.soft_limits[limit][0],
                                          c->settings.soft_limits[limit][1]);
        previous[i] = c->target.asked[i];
    }
    is_other = mpc_find_target(c, goal);
    memcpy(beyond, c->target.u, sizeof beyond);
#if MPC_REGION
    if (is_other) mpc_rg_choose(c);
    else mpc_rg_tail(c, beyond);
#elif MPC_LINEAR
    {
        const double begin = MPC_CLOCK();
        mpc_choose_model(c, is_other);
        c->linearise_seconds += MPC_CLOCK() - begin;
    }
#else
    (void)is_other;
#endif
    for (i = 0; i < MPC_N_R; i++) {
        /* What cannot be held must not be striven for either. */
        const double reached = c->target.projected ? c->target.reached[i] : goal[i];
        for (k = 0; k < MPC_N; k++)
            if (c->reference[k * MPC_N_R + i] == asked[i]) c->reference[k * MPC_N_R + i] = reached;
        if (c->target.asked[i] != previous[i]) changed = 1;
    }
#if !MPC_LINEAR
    mpc_find_rates(c);
#endif
    if (c->first) {
        mpc_hold_everywhere(c->target.u, c->plan);
        c->first = 0;
        return 0;
    }
    mpc_shift_plan(c, beyond);
    /* What overflowed once must not stay in the plan. */
    if (!mpc_finite(c->plan, MPC_N_Z)) mpc_hold_everywhere(c->target.u, c->plan);
    return changed && !foreseen;
}

/* The declared command of a step without a solution. */
static mpc_status mpc_fall_back(const mpc_ctx *c, mpc_reason reason, double *u, mpc_info *info) {
    mpc_fallback chosen = (mpc_fallback)c->settings.fallback;
    double candidate[MPC_N_U];
    int i;
    for (i = 0; i < MPC_N_U; i++)
        candidate[i] = chosen == MPC_SHIFTED_PLAN                      ? c->plan[i]
                       : chosen == MPC_STEADY_INPUT && c->has_target ? c->target.u[i]
                                                                       : c->last_u[i];
    if (!mpc_finite(candidate, MPC_N_U) || (chosen == MPC_STEADY_INPUT && !c->has_target)) {
        chosen = chosen == MPC_STOP ? MPC_STOP : MPC_HOLD;
        memcpy(candidate, c->last_u, sizeof candidate);
    }
    for (i = 0; i < MPC_N_U; i++)
        u[i] = mpc_clipped(candidate[i], c->settings.lower[i], c->settings.upper[i]);
    info->status = MPC_FAILED;
    info->fallback = chosen;
    info->reason = reason;
    return MPC_FAILED;
}

/* A controller whose settings are there. */
static void mpc_start(mpc_ctx *c, const double *u_first) {
    int i;
    c->first = 1;
    c->remaining_share = HUGE_VAL;
    c->target_is_held = 1;
    for (i = 0; i < MPC_N_U; i++) c->last_u[i] = isfinite(u_first[i]) ? u_first[i] : 0;
    for (i = 0; i < MPC_N_FULL; i++) c->full[i] = c->settings.full_rest[i];
    mpc_settle_memory(c, c->full, c->last_u, 100000);
}

void mpc_init_at(mpc_ctx *c, const double *u_first) {
    memset(c, 0, sizeof *c);
    c->settings = mpc_exported_settings;
    mpc_start(c, u_first);
}

void mpc_init(mpc_ctx *c) {
    static const double none[MPC_N_U] = {0};
    mpc_init_at(c, none);
}

mpc_status mpc_step(mpc_ctx *c, const double *x_hat, const double *w_hat,
                    const double *reference, const double *u_previous, double *u,
                    mpc_info *info) {
    mpc_info ignored;
    mpc_outcome outcome;
    int i, usable;
    if (info == NULL) info = &ignored;
    memset(info, 0, sizeof *info);
    info->objective = info->merit = info->violation = NAN;
    info->terminal_residual = info->kkt_residual = NAN;
    c->steady_iterations = c->qp_iterations = 0;
    c->linearise_seconds = c->qp_seconds = 0;
    for (i = 0; i < MPC_N_W; i++) c->w[i] = c->settings.compensation && w_hat != NULL ? w_hat[i] : 0;
    usable = mpc_finite(u_previous, MPC_N_U);
    if (usable) memcpy(c->last_u, u_previous, sizeof c->last_u);
    usable = usable && mpc_finite(x_hat, MPC_N_X) && mpc_finite(c->w, MPC_N_W) &&
             mpc_finite(reference, MPC_N_R * (MPC_PREVIEW + 1));
    if (!usable) {
        mpc_fall_back(c, MPC_NOT_FINITE, u, info);
    } else {
        mpc_solve(c, mpc_begin(c, x_hat, reference), &outcome);
        info->iterations = outcome.iterations;
        if (outcome.failed) {
            mpc_fall_back(c, outcome.failed, u, info);
        } else {
            memcpy(u, c->plan, MPC_N_U * sizeof *u);
            info->status = outcome.terminal_residual > MPC_RELAXED_ABOVE ? MPC_RELAXED
                           : outcome.converged && !c->qp.is_capped       ? MPC_OK
                                                                         : MPC_BUDGET;
            info->objective = outcome.objective;
            info->merit = outcome.merit;
            info->violation = outcome.violation;
            info->terminal_residual = outcome.terminal_residual;
            info->kkt_residual = outcome.kkt_residual;
        }
    }
    info->qp_iterations = c->qp_iterations;
    info->capped = c->qp.is_capped;
    info->steady_iterations = c->steady_iterations;
    info->target_projected = c->has_target && c->target.projected;
    info->target_has_no_region = MPC_REGION && c->has_target && !mpc_in_region(c);
    info->target_held = c->target_is_held;
    memcpy(c->last_u, u, sizeof c->last_u);
    return info->status;
}
