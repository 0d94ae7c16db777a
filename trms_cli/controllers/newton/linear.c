/* ------------------------------------------------------------------------------------------
 * The prediction of a linear model: the same in all periods,
 *
 *     x_next = A x + B u + drift
 *
 * taken at the operating point, at the target, or at the present estimate and the last command.
 * Where an input has lost most of its effect in it (a rotor at rest has a thrust without slope),
 * the model of the operating point stands in.
 * ------------------------------------------------------------------------------------------ */

enum { MPC_FIXED = 0, MPC_OF_TARGET = 1, MPC_CURRENT = 2 };

#define MPC_SAME_TARGET 0.01 /* V: a target whose inputs moved less keeps its linear model */

/* Whether each input, held over the horizon, moves the weighted states far enough. */
static int mpc_drives(const mpc_ctx *c, const mpc_linear *model) {
    const mpc_settings *s = &c->settings;
    double now[MPC_N_FULL][MPC_N_U] = {{0}}, next[MPC_N_FULL][MPC_N_U];
    int k, i, j, m;
    for (k = 0; k < MPC_N; k++) {
        for (i = 0; i < MPC_N_FULL; i++)
            for (j = 0; j < MPC_N_U; j++) {
                double sum = model->F[i][MPC_N_FULL + j];
                for (m = 0; m < MPC_N_FULL; m++) sum += model->F[i][m] * now[m][j];
                next[i][j] = sum;
            }
        memcpy(now, next, sizeof now);
    }
    for (j = 0; j < MPC_N_U; j++) {
        double effect = 0;
        for (i = 0; i < MPC_N_WEIGHTED; i++)
            effect += sqrt(s->state_weights[i]) * fabs(now[mpc_weighted_row[i]][j]);
        if (!(effect >= s->least_effect[j])) return 0;
    }
    return 1;
}

/* The slopes at a state and a command; whether they may be used. `stage_next` is the state after. */
static int mpc_slopes_at(mpc_ctx *c, const double *x, const double *u, mpc_linear *model) {
    mpc_advance_with_slopes(c, x, u, c->stage_next, model->F);
    return mpc_finite(model->F[0], MPC_N_FULL * MPC_N_F) && mpc_drives(c, model);
}

/* What a model has to add so that x and u lead to `next`. */
static void mpc_lead_to(mpc_linear *model, const double *x, const double *u, const double *next) {
    double reached[MPC_N_FULL];
    int i;
    memset(model->drift, 0, sizeof model->drift);
    mpc_predict_linear(model, x, u, reached);
    for (i = 0; i < MPC_N_FULL; i++) model->drift[i] = next[i] - reached[i];
}

static void mpc_operating_model(const mpc_ctx *c, mpc_linear *model) {
    int i;
    memset(model, 0, sizeof *model);
    for (i = 0; i < MPC_N_FULL; i++)
        memcpy(model->F[i], c->settings.operating_model + i * MPC_N_V, MPC_N_V * sizeof(double));
}

/* The linear model of this sample; `is_other`: whether the target is another. */
static void mpc_choose_model(mpc_ctx *c, int is_other) {
    const int way = c->settings.linearisation;
    double *centre = c->region.centre;
    mpc_linear *model = &c->model;
    int i, has_moved = 0;
    if (is_other) { /* the target, with what is remembered of past commands */
        for (i = 0; i < MPC_N_X; i++) centre[i] = c->target.x[i];
        memcpy(centre + MPC_N_FULL, c->target.u, sizeof c->target.u);
        mpc_settle_memory(c, centre, c->target.u, 100000);
    }
    if (!c->has_model) {
        mpc_operating_model(c, model);
        memcpy(c->model_input, c->settings.operating_input, sizeof c->model_input);
        memcpy(c->region.root, c->settings.end_root, sizeof c->region.root);
        c->has_model = 1;
    }
    if (way == MPC_CURRENT) {
        if (mpc_slopes_at(c, c->full, c->last_u, model)) {
            mpc_lead_to(model, c->full, c->last_u, c->stage_next);
            return;
        }
        mpc_operating_model(c, model);
    } else if (way == MPC_OF_TARGET) {
        for (i = 0; i < MPC_N_U; i++)
            if (fabs(c->target.u[i] - c->model_input[i]) > MPC_SAME_TARGET) has_moved = 1;
        if (has_moved) {
            if (!mpc_slopes_at(c, centre, c->target.u, model)) mpc_operating_model(c, model);
            memcpy(c->model_input, c->target.u, sizeof c->model_input);
        }
    }
    mpc_lead_to(model, centre, c->target.u, centre); /* the target is a steady state */
}
