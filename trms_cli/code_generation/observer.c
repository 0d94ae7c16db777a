/* ------------------------------------------------------------------------------------------
 * The observer: a filter that carries mean and covariance from sample to sample; the step itself
 * is among the generated functions. A sample that is missing (NaN, or not in the mask) or beyond
 * the gate is left out; a channel that was rejected for long is believed again.
 * ------------------------------------------------------------------------------------------ */

static void mpc_observer_evaluate(mpc_observer *o) {
    const double *arguments[MPC_ROOM(MPC_FILTER_ARG)];
    double *results[MPC_ROOM(MPC_FILTER_RES)];
    arguments[0] = o->mean;
    arguments[1] = o->covariance;
    arguments[2] = o->memory;
    arguments[3] = o->u;
    arguments[4] = o->y;
    arguments[5] = o->mask;
    arguments[6] = &o->advance;
    arguments[7] = o->known;
    arguments[8] = o->p;
    arguments[9] = mpc_filter_q;
    arguments[10] = mpc_filter_r;
    arguments[11] = mpc_filter_floor;
    arguments[12] = o->gate;
    results[0] = o->mean_next;
    results[1] = o->covariance_next;
    results[2] = o->memory_next;
    results[3] = &o->health;
    results[4] = o->sd;
    results[5] = o->disturbance;
    results[6] = o->disturbance_sd;
    results[7] = o->predicted;
    results[8] = o->innovation;
    results[9] = o->innovation_sd;
    results[10] = o->rejected;
    mpc_filter_step(arguments, results, o->iw, o->work, 0);
}

static void mpc_observer_prior(double *covariance) {
    int i;
    memset(covariance, 0, MPC_N_Z_HAT * MPC_N_Z_HAT * sizeof *covariance);
    for (i = 0; i < MPC_N_Z_HAT; i++)
        covariance[i * MPC_N_Z_HAT + i] = mpc_filter_sd[i] * mpc_filter_sd[i];
}

/* A finite estimate when a factorisation failed or the model overflowed: from the prior
 * covariance, then from the prior mean too, then without the measurement. */
static void mpc_observer_recover(mpc_observer *o) {
    o->recoveries++;
    mpc_observer_prior(o->covariance);
    mpc_observer_evaluate(o);
    if (!isfinite(o->health)) {
        memcpy(o->mean, o->prior_mean, sizeof o->mean);
        mpc_observer_evaluate(o);
    }
    if (!isfinite(o->health)) {
        memset(o->mask, 0, sizeof o->mask);
        mpc_observer_evaluate(o);
    }
    if (isfinite(o->health)) return;
    memset(o->sd, 0, sizeof o->sd);
    memset(o->disturbance, 0, sizeof o->disturbance);
    memset(o->disturbance_sd, 0, sizeof o->disturbance_sd);
    memset(o->predicted, 0, sizeof o->predicted);
    memset(o->innovation, 0, sizeof o->innovation);
    memset(o->innovation_sd, 0, sizeof o->innovation_sd);
    memset(o->rejected, 0, sizeof o->rejected);
    memcpy(o->mean_next, o->mean, sizeof o->mean);
    memcpy(o->covariance_next, o->covariance, sizeof o->covariance);
    memcpy(o->memory_next, o->memory, sizeof o->memory);
}

/* Count runs of rejection and of agreement; whether a channel is to be believed from now on. */
static int mpc_observer_gate(mpc_observer *o) {
    int i, widened = 0, any = o->counting;
    for (i = 0; i < MPC_N_Y; i++) any = any || o->rejected[i] != 0;
    if (!any) return 0;
    o->counting = 0;
    for (i = 0; i < MPC_N_Y; i++) {
        const int within = fabs(o->innovation[i]) <= MPC_GATE * o->innovation_sd[i];
        const int counts = o->open[i] ? within : o->rejected[i] > 0;
        if (o->mask[i] != 0) o->run[i] = counts ? o->run[i] + 1 : 0;
        if (o->run[i] >= MPC_PATIENCE) {
            widened = widened || !o->open[i];
            o->run[i] = 0;
            o->open[i] = !o->open[i];
        }
        o->gate[i] = o->open[i] ? HUGE_VAL : MPC_GATE * MPC_GATE;
        o->counting = o->counting || o->run[i] || o->open[i];
    }
    return widened;
}

void mpc_observer_init(mpc_observer *o, const double *y_first, const double *u_first) {
    int i, k;
    double s[MPC_N_S];
    memset(o, 0, sizeof *o);
    memcpy(o->p, mpc_filter_p, sizeof o->p);
    for (i = 0; i < MPC_N_U; i++) o->u[i] = u_first && isfinite(u_first[i]) ? u_first[i] : 0;
    for (i = 0; i < MPC_N_S; i++) s[i] = mpc_exported_settings.steady_rest[i];
    for (i = 0; i < MPC_N_Y; i++)
        if (mpc_filter_measured[i] >= 0 && y_first && isfinite(y_first[i]))
            s[mpc_filter_measured[i]] = y_first[i];
    /* What is not measured is at rest with what is. */
    for (k = 0; k < 50; k++) {
        const double *arguments[MPC_ROOM(MPC_RESTING_ARG)];
        double *results[MPC_ROOM(MPC_RESTING_RES)], next[MPC_N_S], x[MPC_N_X], move;
        arguments[0] = s;
        arguments[1] = o->u;
        arguments[2] = mpc_resting_p;
        results[0] = next;
        results[1] = &move;
        results[2] = x;
        mpc_resting_step(arguments, results, o->iw, o->work, 0);
        for (i = 0; i < MPC_N_X; i++) o->mean[i] = x[i];
        if (!isfinite(move) || move < 1e-12) break;
        memcpy(s, next, sizeof s);
    }
#if MPC_N_MEMORY
    {
        double full[MPC_N_X + MPC_N_MEMORY], after[MPC_N_X + MPC_N_MEMORY];
        static const double still[MPC_ROOM(MPC_N_W)] = {0};
        int settled = 0;
        for (i = 0; i < MPC_N_X; i++) full[i] = o->mean[i];
        for (i = 0; i < MPC_N_MEMORY; i++) full[MPC_N_X + i] = 0;
        for (k = 0; k < 100000 && !settled; k++) {
            const double *arguments[MPC_ROOM(MPC_SAMPLE_ARG)];
            double *results[MPC_ROOM(MPC_SAMPLE_RES)];
            arguments[0] = full;
            arguments[1] = o->u;
            arguments[2] = mpc_resting_p;
            arguments[3] = still;
            results[0] = after;
            mpc_sample_step(arguments, results, o->iw, o->work, 0);
            settled = !memcmp(full + MPC_N_X, after + MPC_N_X, MPC_N_MEMORY * sizeof *full);
            memcpy(full + MPC_N_X, after + MPC_N_X, MPC_N_MEMORY * sizeof *full);
        }
        memcpy(o->memory, full + MPC_N_X, MPC_N_MEMORY * sizeof *full);
    }
#endif
    memcpy(o->prior_mean, o->mean, sizeof o->mean);
    mpc_observer_prior(o->covariance);
    for (i = 0; i < MPC_N_Y; i++) o->gate[i] = MPC_GATE * MPC_GATE;
}

void mpc_observe(mpc_observer *o, const double *u, const double *y, const int *mask,
                 double *x_hat, double *w_hat) {
    int i;
    for (i = 0; i < MPC_N_U; i++)
        if (isfinite(u[i])) o->u[i] = u[i];
    for (i = 0; i < MPC_N_Y; i++) {
        const int present = isfinite(y[i]) && (mask == NULL || mask[i]);
        o->mask[i] = present;
        o->y[i] = present ? y[i] : 0;
    }
    /* At time zero there is nothing to predict over. */
    o->advance = o->started;
    o->started = 1;
    mpc_observer_evaluate(o);
    if (!isfinite(o->health)) mpc_observer_recover(o);
    memcpy(o->mean, o->mean_next, sizeof o->mean);
    memcpy(o->covariance, MPC_STEADY_GAIN ? mpc_filter_settled : o->covariance_next,
           sizeof o->covariance);
    memcpy(o->memory, o->memory_next, sizeof o->memory);
    if (MPC_GATE < HUGE_VAL && mpc_observer_gate(o))
        for (i = 0; i < MPC_N_Z_HAT; i++)
            o->covariance[i * MPC_N_Z_HAT + i] += mpc_filter_sd[i] * mpc_filter_sd[i];
    memcpy(x_hat, o->mean, MPC_N_X * sizeof *x_hat);
    if (w_hat != NULL)
        for (i = 0; i < MPC_N_W; i++) w_hat[i] = o->disturbance[i];
}
