/* ------------------------------------------------------------------------------------------
 * Steady states: where the rig rests at a reference under constant torques, or the closest
 * reference that it can reach, by Newton's method on the optimality conditions with the bounds
 * of the inputs in an active set.
 * ------------------------------------------------------------------------------------------ */

#define SS_TOLERANCE 1e-8      /* rates (states' units per s), moves (rad) */
#define SS_REACHED 1e-6        /* rad */
#define SS_ITERATIONS 40       /* of one start */
#define SS_RUNAWAY 1e6         /* rad in one iteration */
#define SS_BOUND_TOLERANCE 1e-9 /* V */
#define SS_SLOPE_TOLERANCE 1e-12
#define SS_BESIDE 0.05         /* rad between references that share their closest point */
#define SS_N (MPC_N_S + MPC_N_U)
/* Of a search with the angles at the reference. */
#define SS_QUICK_TOLERANCE 1e-10
#define SS_QUICK_ITERATIONS 6
#define SS_QUICK_SHARE 0.5 /* of its limit, that an input moves in an iteration at most */

static void mpc_ss_evaluate(mpc_ctx *c) {
    const double *arguments[MPC_ROOM(MPC_STEADY_ARG)];
    double *results[MPC_ROOM(MPC_STEADY_RES)];
    mpc_steady *s = &c->steady;
    arguments[0] = s->z;
    arguments[1] = s->r;
    arguments[2] = s->w;
    arguments[3] = c->settings.p;
    arguments[4] = c->settings.steady_weights;
    arguments[5] = s->active;
    arguments[6] = s->bound;
    arguments[7] = c->settings.upper;
    arguments[8] = &s->curved;
    results[0] = s->z_next;
    results[1] = s->report;
    results[2] = s->x;
    mpc_steady_state_step(arguments, results, c->iw, c->work, 0);
}

/* Newton's method with the active inputs at their bounds; whether it converged. */
static int mpc_ss_converge(mpc_ctx *c, const int *active, int curved) {
    mpc_steady *s = &c->steady;
    int i, k;
    for (i = 0; i < MPC_N_U; i++) {
        s->active[i] = active[i] != 0;
        s->bound[i] = active[i] * c->settings.upper[i];
    }
    s->curved = curved;
    for (k = 0; k < SS_ITERATIONS; k++) {
        mpc_ss_evaluate(c);
        c->steady_iterations++;
        if (s->report[0] <= SS_TOLERANCE && s->report[1] <= SS_TOLERANCE) return 1;
        if (!(s->report[1] < SS_RUNAWAY)) return 0;
        memcpy(s->z, s->z_next, sizeof s->z);
    }
    return 0;
}

static int mpc_ss_beyond_stops(const mpc_ctx *c) {
    int i;
    for (i = 0; i < MPC_N_R; i++)
        if (fabs(c->steady.z[mpc_steady_controlled[i]]) > c->settings.stops[i] + SS_REACHED)
            return 1;
    return 0;
}

static int mpc_ss_outside(const mpc_ctx *c, const int *active) {
    int i;
    if (mpc_ss_beyond_stops(c)) return 1;
    for (i = 0; i < MPC_N_U; i++)
        if (active[i] == 0 &&
            fabs(c->steady.z[MPC_N_S + i]) > c->settings.upper[i] + SS_BOUND_TOLERANCE)
            return 1;
    return 0;
}

/* The active set after violated bounds are added and pulling ones released; whether it changed. */
static int mpc_ss_correct(const mpc_ctx *c, int *active) {
    int i, changed = 0;
    for (i = 0; i < MPC_N_U; i++) {
        int after = active[i];
        if (active[i] == 0) {
            const double value = c->steady.z[MPC_N_S + i];
            const double high = c->settings.upper[i] + SS_BOUND_TOLERANCE;
            after = (value > high) - (value < -high);
        } else if (c->steady.report[2 + i] * active[i] > SS_SLOPE_TOLERANCE) {
            after = 0;
        }
        changed |= after != active[i];
        active[i] = after;
    }
    return changed;
}

static void mpc_ss_target(const mpc_ctx *c, const double *asked, const int *active,
                          mpc_target *target) {
    const mpc_steady *s = &c->steady;
    int i;
    target->projected = 0;
    for (i = 0; i < MPC_N_X; i++) target->x[i] = s->x[i];
    for (i = 0; i < MPC_N_U; i++) {
        target->active[i] = active[i];
        target->u[i] = active[i] ? active[i] * c->settings.upper[i] : s->z[MPC_N_S + i];
    }
    for (i = 0; i < MPC_N_R; i++) {
        target->asked[i] = asked[i];
        target->reached[i] = s->z[mpc_steady_controlled[i]];
        if (fabs(asked[i] - target->reached[i]) > SS_REACHED) target->projected = 1;
    }
    for (i = 0; i < MPC_N_S; i++) target->multiplier[i] = s->z[SS_N + i];
    target->residual = s->report[0];
    target->converged = target->residual <= SS_TOLERANCE;
}

static int mpc_ss_from(mpc_ctx *c, const mpc_target *guess, const double *asked,
                       mpc_target *target) {
    mpc_steady *s = &c->steady;
    int i, k, most = 1, active[MPC_N_U];
    for (i = 0; i < MPC_N_S; i++) {
        s->z[i] = guess->x[mpc_steady_rows[i]];
        s->z[SS_N + i] = guess->multiplier[i];
    }
    for (i = 0; i < MPC_N_PATHS; i++)
        s->z[mpc_memory_unknown[i]] = s->rest[mpc_memory_unknown[i]];
    for (i = 0; i < MPC_N_U; i++) {
        s->z[MPC_N_S + i] = guess->u[i];
        active[i] = guess->active[i];
        most *= 3;
    }
    for (k = 0; k < most; k++) {
        if (!mpc_ss_converge(c, active, guess->projected)) return 0;
        if (mpc_ss_correct(c, active)) continue;
        if (mpc_ss_beyond_stops(c)) return 0;
        mpc_ss_target(c, asked, active, target);
        return 1;
    }
    return 0;
}

/* The digits of `index` to the base `base`, the last one the fastest. */
static void mpc_ss_digits(int index, int base, int *digits) {
    int i;
    for (i = MPC_N_U - 1; i >= 0; i--) {
        digits[i] = index % base;
        index /= base;
    }
}

static double mpc_ss_cost(const mpc_ctx *c) {
    double cost = 0;
    int i;
    for (i = 0; i < MPC_N_R; i++) {
        const double error = c->steady.z[mpc_steady_controlled[i]] - c->steady.r[i];
        cost += error * (c->settings.steady_weights[i] * error);
    }
    return cost;
}

/* A start: at the reference or at rest, each input at 0.4 of its limit or against it. */
static void mpc_ss_start(mpc_ctx *c, int at_reference, int signs) {
    mpc_steady *s = &c->steady;
    int i, digits[MPC_N_U];
    for (i = 0; i < MPC_N_S; i++) {
        s->z[i] = s->rest[i];
        s->z[SS_N + i] = 0.0;
    }
    if (at_reference)
        for (i = 0; i < MPC_N_R; i++) s->z[mpc_steady_controlled[i]] = s->r[i];
    mpc_ss_digits(signs, 2, digits);
    for (i = 0; i < MPC_N_U; i++)
        s->z[MPC_N_S + i] = (digits[i] ? -0.4 : 0.4) * c->settings.upper[i];
}

/* The best over several starts and all active sets. */
static void mpc_ss_from_afar(mpc_ctx *c, const double *asked, mpc_target *target) {
    static const int sides[3] = {0, 1, -1};
    mpc_steady *s = &c->steady;
    mpc_target candidate;
    double best = 0;
    int i, set, start, n_sets = 1, n_signs = 1, found = 0, active[MPC_N_U], digits[MPC_N_U];
    for (i = 0; i < MPC_N_U; i++) {
        n_sets *= 3;
        n_signs *= 2;
    }
    for (set = 0; set < n_sets; set++) {
        mpc_ss_digits(set, 3, digits);
        for (i = 0; i < MPC_N_U; i++) active[i] = sides[digits[i]];
        for (start = 0; start < 2 * n_signs; start++) {
            double cost;
            mpc_ss_start(c, start < n_signs, start % n_signs);
            if (!mpc_ss_converge(c, active, 0) && !mpc_ss_converge(c, active, 1)) continue;
            if (mpc_ss_outside(c, active)) continue;
            mpc_ss_target(c, asked, active, &candidate);
            if (!candidate.projected) {
                *target = candidate;
                return;
            }
            cost = mpc_ss_cost(c);
            if (!found || cost < best - SS_SLOPE_TOLERANCE) {
                found = 1;
                best = cost;
                *target = candidate;
            }
        }
    }
    if (found) return;
    for (i = 0; i < MPC_N_S; i++) {
        s->z[i] = s->rest[i];
        s->z[SS_N + i] = 0.0;
    }
    for (i = 0; i < MPC_N_U; i++) {
        s->z[MPC_N_S + i] = 0.0;
        active[i] = 0;
    }
    mpc_ss_evaluate(c);
    mpc_ss_target(c, asked, active, target);
}

/* The reference itself where it can be held with no input at its bound. */
static int mpc_ss_within_reach(mpc_ctx *c, const double *asked, mpc_target *target) {
    mpc_target candidate;
    int i, start, n_signs = 1, active[MPC_N_U];
    for (i = 0; i < MPC_N_U; i++) {
        n_signs *= 2;
        active[i] = 0;
    }
    for (start = 0; start < n_signs; start++) {
        mpc_ss_start(c, 1, start);
        if (!mpc_ss_converge(c, active, 0) || mpc_ss_outside(c, active)) continue;
        mpc_ss_target(c, asked, active, &candidate);
        if (candidate.projected) continue;
        *target = candidate;
        return 1;
    }
    return 0;
}

#if MPC_REACHING
/* The target of a reference that is reached with no input at its bound, from such a target: the
 * angles stand at the reference, and f = 0 alone is solved. Whether it is one. */
static int mpc_ss_reach(mpc_ctx *c, const mpc_target *guess, const double *asked,
                        mpc_target *target) {
    static const int no_bounds[MPC_N_U] = {0};
    const double *arguments[MPC_ROOM(MPC_REACHING_ARG)];
    double *results[MPC_ROOM(MPC_REACHING_RES)];
    mpc_steady *s = &c->steady;
    int i, k;
    if (guess->projected) return 0;
    for (i = 0; i < MPC_N_U; i++)
        if (guess->active[i]) return 0;
    for (i = 0; i < MPC_N_R; i++)
        if (s->r[i] != asked[i]) return 0;
    for (i = 0; i < MPC_N_S; i++) {
        s->z[i] = guess->x[mpc_steady_rows[i]];
        s->z[SS_N + i] = 0;
    }
    memcpy(s->z + MPC_N_S, guess->u, sizeof guess->u);
    for (i = 0; i < MPC_N_R; i++) s->z[mpc_steady_controlled[i]] = asked[i];
    arguments[0] = s->z;
    arguments[1] = s->w;
    arguments[2] = c->settings.p;
    results[0] = s->z_next;
    results[1] = s->report;
    results[2] = s->x;
    for (k = 0; k < SS_QUICK_ITERATIONS; k++) {
        mpc_reaching_step(arguments, results, c->iw, c->work, 0);
        c->steady_iterations++;
        if (s->report[0] <= SS_QUICK_TOLERANCE) break;
        for (i = MPC_N_S; i < SS_N; i++)
            if (!(fabs(s->z_next[i] - s->z[i]) <= SS_QUICK_SHARE * c->settings.upper[i - MPC_N_S]))
                return 0;
        memcpy(s->z, s->z_next, SS_N * sizeof *s->z);
    }
    if (k == SS_QUICK_ITERATIONS || mpc_ss_outside(c, no_bounds)) return 0;
    mpc_ss_target(c, asked, no_bounds, target);
    return 1;
}
#endif

static void mpc_ss_solve(mpc_ctx *c, const double *asked, const double *w,
                         const mpc_target *guess, mpc_target *target) {
    mpc_steady *s = &c->steady;
    int i, beside;
    for (i = 0; i < MPC_N_R; i++) {
        const double stop = c->settings.stops[i];
        s->r[i] = asked[i] < -stop ? -stop : asked[i] > stop ? stop : asked[i];
    }
    for (i = 0; i < MPC_N_W; i++) s->w[i] = w[i];
    for (i = 0; i < MPC_N_S; i++) s->rest[i] = c->settings.steady_rest[i];
    for (i = 0; i < MPC_N_PATHS; i++)
        s->rest[mpc_memory_unknown[i]] = c->full[mpc_memory_row[i]];
#if MPC_REACHING
    if (guess != NULL && mpc_ss_reach(c, guess, asked, target)) return;
#endif
    if (guess != NULL && mpc_ss_from(c, guess, asked, target)) {
        /* The closest point found from nearby may be closest in its neighbourhood only, and what
         * kept the reference out of reach may have gone. */
        beside = guess->projected;
        for (i = 0; i < MPC_N_R; i++)
            if (!(fabs(asked[i] - guess->asked[i]) < SS_BESIDE)) beside = 0;
        if (!target->projected) return;
        if (beside) {
            mpc_ss_within_reach(c, asked, target);
            return;
        }
    }
    mpc_ss_from_afar(c, asked, target);
}
