/* Times the observer, whose work does not depend on what it is told. */
static void time_observer(void) {
    static mpc_observer observer;
    double y[MPC_N_Y] = {0}, u[MPC_N_U] = {0}, x_hat[MPC_N_X], w_hat[MPC_ROOM(MPC_N_W)];
    int k, i;
    const int count = 5000;
    mpc_observer_init(&observer, NULL, NULL);
    for (k = 0; k < count; k++) {
        struct timespec begin, end;
        for (i = 0; i < MPC_N_Y; i++)
            y[i] = observer.predicted[i] + 1e-4 * ((7 * k + 3 * i) % 11 - 5);
        clock_gettime(CLOCK_MONOTONIC, &begin);
        mpc_observe(&observer, u, y, NULL, x_hat, w_hat);
        clock_gettime(CLOCK_MONOTONIC, &end);
        times[k] = microseconds(begin, end);
    }
    qsort(times, (size_t)count, sizeof *times, ascending);
    printf("observer_median_us %.2f\n", times[count / 2]);
    printf("observer_p99_us %.2f\n", times[(int)(0.99 * (count - 1))]);
    printf("observer_max_us %.2f\n", times[count - 1]);
    printf("observer_bytes %lu\n", (unsigned long)sizeof observer);
}

