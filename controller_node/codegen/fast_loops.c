// Code that fast_loops.py inserts into CasADi's generated C, which defines casadi_real and casadi_int.
// The file is split at its comment lines; comment lines and empty lines are not inserted.

// Vectors of eight and of four in a notation of gcc and clang. The compiler maps them to the machine's registers.
#include <string.h>
typedef double tandem_v8 __attribute__((vector_size(64)));
typedef double tandem_v4 __attribute__((vector_size(32)));
typedef long long tandem_i8 __attribute__((vector_size(64)));
static inline tandem_v8 tandem_load(const double* p) { tandem_v8 v; memcpy(&v, p, sizeof(v)); return v; }
static inline void tandem_add(double* p, tandem_v8 v) { v += tandem_load(p); memcpy(p, &v, sizeof(v)); }

// CasADi's own product computes one entry after the other, each by a sum of dependent operations. This one keeps tiles
// of independent sums in registers: 8 x 8 and 4 x 8 for many columns, and 32 rows for a single column.
static inline tandem_v4 tandem_load4(const double* p) { tandem_v4 v; memcpy(&v, p, sizeof(v)); return v; }
static inline void tandem_add4(double* p, tandem_v4 v) { v += tandem_load4(p); memcpy(p, &v, sizeof(v)); }
#define TANDEM_TILE(VECTOR, LOAD, ADD) do { \
  const casadi_real *a = x + j, *b = y + i*ncol_x; \
  VECTOR s0 = {0}, s1 = {0}, s2 = {0}, s3 = {0}, s4 = {0}, s5 = {0}, s6 = {0}, s7 = {0}; \
  casadi_real* r = z + j + i*nrow_x; \
  for (k=0; k<ncol_x; ++k, a+=nrow_x, ++b) { \
    VECTOR v = LOAD(a); \
    s0 += v*b[0]; s1 += v*b[ncol_x]; s2 += v*b[2*ncol_x]; s3 += v*b[3*ncol_x]; \
    s4 += v*b[4*ncol_x]; s5 += v*b[5*ncol_x]; s6 += v*b[6*ncol_x]; s7 += v*b[7*ncol_x]; \
  } \
  ADD(r, s0); ADD(r + nrow_x, s1); ADD(r + 2*nrow_x, s2); ADD(r + 3*nrow_x, s3); \
  ADD(r + 4*nrow_x, s4); ADD(r + 5*nrow_x, s5); ADD(r + 6*nrow_x, s6); ADD(r + 7*nrow_x, s7); \
} while (0)
#define TANDEM_COLUMN(VECTOR, LOAD, ADD) do { \
  const casadi_real *a = x + j, *b = y + i*ncol_x; \
  VECTOR s0 = {0}, s1 = {0}, s2 = {0}, s3 = {0}; \
  for (k=0; k+4<=ncol_x; k+=4, a+=4*nrow_x) { \
    s0 += LOAD(a)*b[k]; s1 += LOAD(a + nrow_x)*b[k+1]; \
    s2 += LOAD(a + 2*nrow_x)*b[k+2]; s3 += LOAD(a + 3*nrow_x)*b[k+3]; \
  } \
  for (; k<ncol_x; ++k, a+=nrow_x) s0 += LOAD(a)*b[k]; \
  ADD(z + j + i*nrow_x, (s0 + s1) + (s2 + s3)); \
} while (0)
void casadi_mtimes_dense(const casadi_real* restrict x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* restrict y, casadi_int ncol_y, casadi_real* restrict z, casadi_int tr) {
  casadi_int i, j, k;
  if (tr) {
    for (i=0; i<ncol_y; ++i)
      for (j=0; j<ncol_x; ++j) {
        casadi_real s = 0;
        for (k=0; k<nrow_x; ++k) s += x[k + j*nrow_x] * y[k + i*nrow_x];
        z[j + i*ncol_x] += s;
      }
    return;
  }
  for (i=0; i+8<=ncol_y; i+=8) {
    for (j=0; j+8<=nrow_x; j+=8) TANDEM_TILE(tandem_v8, tandem_load, tandem_add);
    if (j+4<=nrow_x) TANDEM_TILE(tandem_v4, tandem_load4, tandem_add4);
  }
  for (; i<ncol_y; ++i) {
    for (j=0; j+32<=nrow_x; j+=32) {
      const casadi_real *a = x + j, *b = y + i*ncol_x;
      casadi_real* r = z + j + i*nrow_x;
      tandem_v8 s0 = {0}, s1 = {0}, s2 = {0}, s3 = {0}, t0 = {0}, t1 = {0}, t2 = {0}, t3 = {0};
      for (k=0; k+2<=ncol_x; k+=2, a+=2*nrow_x) {
        const casadi_real* c = a + nrow_x;
        s0 += tandem_load(a)*b[k]; s1 += tandem_load(a + 8)*b[k];
        s2 += tandem_load(a + 16)*b[k]; s3 += tandem_load(a + 24)*b[k];
        t0 += tandem_load(c)*b[k+1]; t1 += tandem_load(c + 8)*b[k+1];
        t2 += tandem_load(c + 16)*b[k+1]; t3 += tandem_load(c + 24)*b[k+1];
      }
      if (k<ncol_x) {
        s0 += tandem_load(a)*b[k]; s1 += tandem_load(a + 8)*b[k];
        s2 += tandem_load(a + 16)*b[k]; s3 += tandem_load(a + 24)*b[k];
      }
      tandem_add(r, s0 + t0); tandem_add(r + 8, s1 + t1); tandem_add(r + 16, s2 + t2); tandem_add(r + 24, s3 + t3);
    }
    for (; j+8<=nrow_x; j+=8) TANDEM_COLUMN(tandem_v8, tandem_load, tandem_add);
    if (j+4<=nrow_x) TANDEM_COLUMN(tandem_v4, tandem_load4, tandem_add4);
  }
  for (j=nrow_x - nrow_x%4; j<nrow_x; ++j)
    for (i=0; i<ncol_y; ++i) {
      casadi_real s = 0;
      for (k=0; k<ncol_x; ++k) s += x[j + k*nrow_x] * y[k + i*ncol_x];
      z[j + i*nrow_x] += s;
    }
}

// tanh x = 1 - 2 / (1 + exp 2x) for eight numbers at a time, without a branch or a call. The absolute error is 2e-16,
// and libm's version takes many times as long. NaN stays NaN. Source and target may be the same array.
static inline tandem_v8 tandem_tanh8(tandem_v8 x) {
  const tandem_v8 zero = {0};
  /* 1.5 * 2^52: adding it leaves the nearest integer in the low bits. */
  const tandem_v8 magic = zero + 6755399441055744.0, high = zero + 80, low = zero - 80;
  tandem_v8 a = 2*x;
  tandem_i8 above = a > high, below = a < low;
  a = (tandem_v8)(((tandem_i8)a & ~above & ~below) | ((tandem_i8)high & above) | ((tandem_i8)low & below));
  tandem_v8 k = a*1.4426950408889634 + magic, whole = k - magic;
  tandem_v8 r = (a - whole*6.93147180369123816490e-01) - whole*1.90821492927058770002e-10;
  tandem_v8 p = r*(1./6227020800) + 1./479001600;
  p = p*r + 1./39916800; p = p*r + 1./3628800; p = p*r + 1./362880; p = p*r + 1./40320; p = p*r + 1./5040;
  p = p*r + 1./720; p = p*r + 1./120; p = p*r + 1./24; p = p*r + 1./6; p = p*r + 0.5; p = p*r + 1; p = p*r + 1;
  tandem_i8 scale = ((tandem_i8)k + 1023) << 52;
  return 1 - 2/(1 + p*(tandem_v8)scale);
}
static void tandem_tanh(const casadi_real* x, casadi_real* y, casadi_int n) {
  casadi_int i;
  for (i=0; i+8<=n; i+=8) {
    tandem_v8 v = tandem_tanh8(tandem_load(x + i));
    memcpy(y + i, &v, sizeof(v));
  }
  if (i<n) {
    tandem_v8 v = {0};
    memcpy(&v, x + i, (n-i)*sizeof(*x));
    v = tandem_tanh8(v);
    memcpy(y + i, &v, (n-i)*sizeof(*x));
  }
}
