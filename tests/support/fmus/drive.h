/* 1/(1 + 2*zeta*p/w + p^2/w^2) of an input that is linear between its samples, by 16 steps of Runge and Kutta.
   1: command [um], 2: position [um], 3: velocity [m/s], 4: w [rad/s], 5: zeta */
static void start(double *v) {
    v[4] = 1000.0;
    v[5] = 0.7;
}

static double pull(Model *m, double u, double x, double s) { return m->v[4] * (m->v[4] * (u - x) - 2 * m->v[5] * s); }

static int compute(Model *m, double h) {
    double x = 1e-6 * m->v[2], s = m->v[3], a = m->before, b = 1e-6 * m->v[1], g = h / 16;
    for (int k = 0; k < 16; k++) {
        double u0 = a + (b - a) * k / 16, u2 = a + (b - a) * (k + 1) / 16, u1 = (u0 + u2) / 2;
        double k1 = pull(m, u0, x, s), s2 = s + g / 2 * k1;
        double k2 = pull(m, u1, x + g / 2 * s, s2), s3 = s + g / 2 * k2;
        double k3 = pull(m, u1, x + g / 2 * s2, s3), s4 = s + g * k3;
        double k4 = pull(m, u2, x + g * s3, s4);
        x += g / 6 * (s + 2 * s2 + 2 * s3 + s4);
        s += g / 6 * (k1 + 2 * k2 + 2 * k3 + k4);
    }
    m->v[2] = 1e6 * x;
    m->v[3] = s;
    m->before = b;
    return 0;
}
