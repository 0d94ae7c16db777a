/* Time-varying Kalman filters over windows, row-major arrays, one window after another.
 * n states, m outputs; sample t of the stack has F[t] (n x n), H[t] (m x n), seen[t] (m).
 * Rows of H of outputs that are missing count as zero. No memory is shared. */
#include <math.h>
#include <string.h>

/* Columns are independent of each other: twice as many at a time where the processor has AVX2,
 * chosen as the library is loaded, with the same sums in the same order. */
#if defined(__GLIBC__) && defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define WIDER __attribute__((target_clones("avx2", "default")))
#else
#define WIDER
#endif

/* Gains, square roots of the innovations' precision, and the logarithm of their determinant.
 * K[t] (n x m) moves the prediction at t: x(t|t) = x(t|t-1) + K e. L[t] (m x m) is the inverse of the
 * lower Cholesky factor of S. P, if not NULL, receives the covariance of each prediction (n x n). */
int trms_gains(long long windows, const long long *count, int n, int m, const double *F,
               const double *H, const unsigned char *seen, const double *r, const double *Q,
               const double *P0, double *K, double *L, double *logdet, double *P_out) {
  double P[n * n], PH[n * m], S[m * m], C[m * m], FP[n * n], G[n * n];
  for (long long j = 0; j < windows; ++j) {
    memcpy(P, P0, sizeof P);
    logdet[j] = 0.0;
    for (long long t = 0; t < count[j]; ++t, F += n * n, H += m * n, seen += m, K += n * m, L += m * m) {
      if (P_out) { memcpy(P_out, P, sizeof P); P_out += n * n; }
      for (int i = 0; i < n; ++i)
        for (int a = 0; a < m; ++a) {
          double s = 0.0;
          if (seen[a]) for (int l = 0; l < n; ++l) s += P[i * n + l] * H[a * n + l];
          PH[i * m + a] = s;
        }
      for (int a = 0; a < m; ++a)
        for (int b = 0; b <= a; ++b) {
          double s = a == b ? (seen[a] ? r[a] : 1.0) : 0.0;
          if (seen[a] && seen[b]) for (int l = 0; l < n; ++l) s += H[a * n + l] * PH[l * m + b];
          S[a * m + b] = s;
        }
      /* Cholesky, and its inverse */
      memset(C, 0, sizeof C);
      for (int a = 0; a < m; ++a)
        for (int b = 0; b <= a; ++b) {
          double s = S[a * m + b];
          for (int l = 0; l < b; ++l) s -= C[a * m + l] * C[b * m + l];
          if (a == b) {
            if (!(s > 0.0)) return 1;
            C[a * m + a] = sqrt(s);
            if (seen[a]) logdet[j] += 2.0 * log(C[a * m + a]);
          } else C[a * m + b] = s / C[b * m + b];
        }
      memset(L, 0, sizeof(double) * m * m);
      for (int b = 0; b < m; ++b) {
        L[b * m + b] = 1.0 / C[b * m + b];
        for (int a = b + 1; a < m; ++a) {
          double s = 0.0;
          for (int l = b; l < a; ++l) s -= C[a * m + l] * L[l * m + b];
          L[a * m + b] = s / C[a * m + a];
        }
      }
      /* W = PH L^T (n x m); K = W L; P = P - W W^T */
      double W[n * m];
      for (int i = 0; i < n; ++i)
        for (int a = 0; a < m; ++a) {
          double s = 0.0;
          for (int b = 0; b <= a; ++b) s += PH[i * m + b] * L[a * m + b];
          W[i * m + a] = s;
        }
      for (int i = 0; i < n; ++i)
        for (int b = 0; b < m; ++b) {
          double s = 0.0;
          for (int a = b; a < m; ++a) s += W[i * m + a] * L[a * m + b];
          K[i * m + b] = s;
        }
      for (int i = 0; i < n; ++i)
        for (int l = 0; l <= i; ++l) {
          double s = P[i * n + l];
          for (int a = 0; a < m; ++a) s -= W[i * m + a] * W[l * m + a];
          G[i * n + l] = G[l * n + i] = s;
        }
      for (int i = 0; i < n; ++i) {
        for (int l = 0; l < n; ++l) FP[i * n + l] = 0.0;
        for (int k = 0; k < n; ++k) {
          const double f = F[i * n + k];
          if (f == 0.0) continue;
          for (int l = 0; l < n; ++l) FP[i * n + l] += f * G[k * n + l];
        }
      }
      for (int i = 0; i < n; ++i)
        for (int l = 0; l <= i; ++l) {
          double s = Q[i * n + l];
          for (int k = 0; k < n; ++k) s += FP[i * n + k] * F[l * n + k];
          P[i * n + l] = P[l * n + i] = s;
        }
    }
  }
  return 0;
}

/* Columns (m x c a sample) made white: out = L (column - H x), x+ = F (x + K (column - H x)). */
WIDER void trms_whiten(long long windows, const long long *count, int n, int m, int c, const double *F,
                 const double *H, const unsigned char *seen, const double *K, const double *L,
                 const double *columns, double *out) {
  double x[n * c], after[n * c], e[m * c];
  for (long long j = 0; j < windows; ++j) {
    memset(x, 0, sizeof x);
    for (long long t = 0; t < count[j];
         ++t, F += n * n, H += m * n, seen += m, K += n * m, L += m * m, columns += m * c, out += m * c) {
      for (int a = 0; a < m; ++a) {
        double *row = e + a * c;
        if (!seen[a]) { memset(row, 0, sizeof(double) * c); continue; }
        memcpy(row, columns + a * c, sizeof(double) * c);
        for (int l = 0; l < n; ++l) {
          const double h = H[a * n + l];
          if (h == 0.0) continue;
          for (int q = 0; q < c; ++q) row[q] -= h * x[l * c + q];
        }
      }
      memset(out, 0, sizeof(double) * m * c);
      for (int a = 0; a < m; ++a) {
        if (!seen[a]) continue;
        for (int b = 0; b <= a; ++b) {
          const double f = L[a * m + b];
          if (f == 0.0 || !seen[b]) continue;
          for (int q = 0; q < c; ++q) out[a * c + q] += f * e[b * c + q];
        }
      }
      for (int i = 0; i < n; ++i)
        for (int a = 0; a < m; ++a) {
          const double f = K[i * m + a];
          if (f == 0.0) continue;
          for (int q = 0; q < c; ++q) x[i * c + q] += f * e[a * c + q];
        }
      memset(after, 0, sizeof after);
      for (int i = 0; i < n; ++i)
        for (int k = 0; k < n; ++k) {
          const double f = F[i * n + k];
          if (f == 0.0) continue;
          for (int q = 0; q < c; ++q) after[i * c + q] += f * x[k * c + q];
        }
      memcpy(x, after, sizeof x);
    }
  }
}

/* Sums over all samples of squares of the smoothed disturbances of the states, scaled, and of their
 * variance: what the slope of the likelihood in the size of each disturbance is made of (Koopman
 * and Shephard 1992, Biometrika 79). e (m a sample) are innovations, not whitened. */
void trms_scores(long long windows, const long long *count, int n, int m, const double *F,
                 const double *H, const unsigned char *seen, const double *K, const double *L,
                 const double *e, double *squares, double *variances) {
  double r[n], N[n * n], A[n * n], T[n * n], V[m * n], g[m];
  for (int i = 0; i < 2 * n; ++i) squares[i] = variances[i] = 0.0;
  for (long long j = 0; j < windows; ++j) {
    memset(r, 0, sizeof r);
    memset(N, 0, sizeof N);
    for (long long k = count[j] - 1; k >= 0; --k) {
      const double *Ft = F + k * n * n, *Ht = H + k * m * n, *Kt = K + k * n * m, *Lt = L + k * m * m;
      const double *et = e + k * m;
      const unsigned char *st = seen + k * m;
      for (int i = 0; i < n; ++i) {
        squares[n + i] += r[i] * r[i];
        variances[n + i] += N[i * n + i];
      }
      /* A = F (I - K H) */
      for (int i = 0; i < n; ++i)
        for (int l = 0; l < n; ++l) {
          double s = i == l ? 1.0 : 0.0;
          for (int a = 0; a < m; ++a) if (st[a]) s -= Kt[i * m + a] * Ht[a * n + l];
          T[i * n + l] = s;
        }
      for (int i = 0; i < n; ++i) {
        for (int l = 0; l < n; ++l) A[i * n + l] = 0.0;
        for (int q = 0; q < n; ++q) {
          const double f = Ft[i * n + q];
          if (f == 0.0) continue;
          for (int l = 0; l < n; ++l) A[i * n + l] += f * T[q * n + l];
        }
      }
      /* V = L H (whitened output), g = L e */
      for (int a = 0; a < m; ++a) {
        double s = 0.0;
        for (int l = 0; l < n; ++l) V[a * n + l] = 0.0;
        if (st[a]) for (int b = 0; b <= a; ++b) {
          if (!st[b]) continue;
          const double f = Lt[a * m + b];
          s += f * et[b];
          for (int l = 0; l < n; ++l) V[a * n + l] += f * Ht[b * n + l];
        }
        g[a] = s;
      }
      double before[n];
      for (int i = 0; i < n; ++i) {
        double s = 0.0;
        for (int a = 0; a < m; ++a) s += V[a * n + i] * g[a];
        for (int l = 0; l < n; ++l) s += A[l * n + i] * r[l];
        before[i] = s;
      }
      memcpy(r, before, sizeof r);
      for (int i = 0; i < n; ++i) {
        for (int l = 0; l < n; ++l) T[i * n + l] = 0.0;
        for (int q = 0; q < n; ++q) {
          const double f = N[i * n + q];
          if (f == 0.0) continue;
          for (int l = 0; l < n; ++l) T[i * n + l] += f * A[q * n + l];
        }
      }
      for (int i = 0; i < n; ++i)
        for (int l = 0; l < n; ++l) {
          double s = 0.0;
          for (int a = 0; a < m; ++a) s += V[a * n + i] * V[a * n + l];
          for (int q = 0; q < n; ++q) s += A[q * n + i] * T[q * n + l];
          N[i * n + l] = s;
        }
    }
    for (int i = 0; i < n; ++i) { /* of the first sample's state */
      squares[i] += r[i] * r[i];
      variances[i] += N[i * n + i];
    }
    F += count[j] * n * n; H += count[j] * m * n; seen += count[j] * m;
    K += count[j] * n * m; L += count[j] * m * m; e += count[j] * m;
  }
}
