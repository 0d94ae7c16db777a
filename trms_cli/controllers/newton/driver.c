/* What a program asks of a controller that it drives from outside, as plain arrays. The line that
 * includes the controller's source stands before this text. */

#include <stddef.h>

void mpc_drive_sizes(int *sizes) {
    sizes[0] = MPC_N_X;
    sizes[1] = MPC_N_U;
    sizes[2] = MPC_N_W;
    sizes[3] = MPC_N_R;
    sizes[4] = MPC_PREVIEW;
    sizes[5] = MPC_N;
    sizes[6] = MPC_N_BLOCKS;
    sizes[7] = MPC_N_FULL;
}

/* Of the context and the settings, in bytes; and the control period, s. */
void mpc_drive_structs(size_t *bytes, double *period) {
    bytes[0] = sizeof(mpc_ctx);
    bytes[1] = sizeof(mpc_settings);
    period[0] = MPC_PERIOD;
}

/* Where the context keeps what is shown of it: plan, present state, trajectory, target. */
void mpc_drive_views(size_t *offsets) {
    offsets[0] = offsetof(mpc_ctx, plan);
    offsets[1] = offsetof(mpc_ctx, full);
    offsets[2] = offsetof(mpc_ctx, trajectory);
    offsets[3] = offsetof(mpc_ctx, target.x);
    offsets[4] = offsetof(mpc_ctx, target.u);
}

/* A fresh controller; with the exported settings if there are none. */
void mpc_drive_begin(mpc_ctx *c, const void *settings, const double *u_first) {
    memset(c, 0, sizeof *c);
    memcpy(&c->settings, settings != NULL ? settings : (const void *)&mpc_exported_settings,
           sizeof c->settings);
    mpc_start(c, u_first);
}

/* A step, and what it says of itself in numbers. */
int mpc_drive_step(mpc_ctx *c, const double *x_hat, const double *w_hat, const double *reference,
                   const double *u_previous, double *u, double *words) {
    mpc_info info;
    const int status = mpc_step(c, x_hat, w_hat, reference, u_previous, u, &info);
    words[0] = info.fallback;
    words[1] = info.reason;
    words[2] = info.iterations;
    words[3] = info.objective;
    words[4] = info.violation;
    words[5] = MPC_N_TERMINAL ? info.terminal_residual : NAN;
    words[6] = info.kkt_residual;
    words[7] = info.target_projected;
    words[8] = info.target_held;
    words[9] = c->linearise_seconds;
    words[10] = c->qp_seconds;
    words[11] = info.qp_iterations;
    words[12] = info.target_has_no_region;
    return status;
}
