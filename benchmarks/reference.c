/* What the compiled steps of usvlearn are measured against: the same mathematics for one boat, in double precision, as
 * a C programmer would write it. Every sample is fresh and measured; p and n are known at run time only.
 *
 * benchmarks/reference.py compiles and calls it, tests/test_reference.py holds it against the estimators. What is here
 * without a word stands in the docstrings of usvlearn/estimators.
 */
#include <float.h>
#include <math.h>
#include <string.h>

enum { P_MAX = 16, N_MAX = 520 };      /* parameters, neurons; rows of 4 KiB would crowd each other out of the cache */
enum { BLOCK = 8 };                    /* numbers in a vector register */
enum { SURGE_DYNAMICS, QUASI_STATIC }; /* models, v+ = base + phi'theta */

typedef struct {
    const double *left, *right, *heading, *yaw_rate, *dt, *surge; /* a number for each step */
} Samples;

static inline double clamp(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static inline double dot(int n, const double *x, const double *y) {
    double sum = 0;
    for (int i = 0; i < n; i++) sum += x[i] * y[i];
    return sum;
}

/* phi; returns the base. Of 12 parameters the last three are a bias and a force from a compass direction. */
static inline double regressor(int model, int p, double mass, const Samples *s, long k, double v, double *phi) {
    double l = s->left[k], r = s->right[k], turn = fabs(s->yaw_rate[k]);
    if (model == QUASI_STATIC) {
        double sine = sin(s->heading[k]), cosine = cos(s->heading[k]);
        double all[] = {r, r * fabs(r), r * r * r, l, l * fabs(l), l * l * l, sine, cosine, turn};
        memcpy(phi, all, sizeof all);
        return 0;
    }
    double speed = fabs(v), step = s->dt[k] / mass;
    double all[] = {speed * v, v, turn * v, l, l * fabs(l), l * speed, r, r * fabs(r), r * speed};
    for (int i = 0; i < 9; i++) phi[i] = step * all[i];
    if (p == 12) {
        phi[9] = step;
        phi[10] = step * sin(s->heading[k]);
        phi[11] = step * cos(s->heading[k]);
    }
    return v;
}

/* ---- least squares */

typedef struct {
    int model, p;
    double mass, surge_max;
    double memory, floor;         /* of SIFt: tau, s; epsilon */
    double forgetting, trace_max; /* of exponential forgetting */
} LeastSquares;

typedef struct {
    double theta[P_MAX];
    double columns[P_MAX][P_MAX]; /* of L, lower triangular, P = L L'; zeros elsewhere */
    double surge, noise, deviation;
} LeastSquaresState;

/* chol(I + c x x'), t_j its running determinants: diagonal[j], and below it x_i slope[j]. */
static inline void rank_one(int p, const double *t, const double *x, double c, double *diagonal, double *slope) {
    for (int j = 0; j < p; j++) {
        double root = 1 / sqrt(t[j] * t[j + 1]);
        diagonal[j] = t[j + 1] * root;
        slope[j] = c * x[j] * root;
    }
}

/* chol(I - f f'/(r + f'f)): its determinants are suffix sums, up to a factor; nothing cancels. Returns r + f'f. */
static inline double contraction(int p, const double *f, double r, double *diagonal, double *slope) {
    double a[P_MAX + 1];
    a[p] = r;
    for (int j = p - 1; j >= 0; j--) a[j] = a[j + 1] + f[j] * f[j];
    rank_one(p, a, f, -1, diagonal, slope);
    return a[0];
}

/* The noise and the deviation by an innovation whose variance is `spread` times the noise's. */
static inline void judge(LeastSquaresState *state, double innovation, double spread) {
    double seen = innovation * innovation / spread;
    state->deviation = sqrt(state->noise * spread);
    seen = seen < 16 * state->noise ? seen : 16 * state->noise;
    seen = state->noise + 0.02 * (seen - state->noise);
    state->noise = seen > 1e-6 ? seen : 1e-6;
}

/* Exponential forgetting: L becomes L chol(I - f f'/s)/sqrt(lambda) with f = L'phi, column by column from the right:
 * entry (i, j) takes the sum of f_k L_ik over k > j, and at the end of the sweep this is L f = P phi, the gain.
 *
 * A column is gone through from the block of its diagonal to that of row p. What lies above the diagonal and below row
 * p is zero and stays so, and no loop has a remainder. */
void rls(long steps, const Samples *s, const LeastSquares *ls, LeastSquaresState *state, double *predictions) {
    int p = ls->p, rows = (p + BLOCK - 1) & -BLOCK;
    double(*L)[P_MAX] = state->columns, *theta = state->theta;
    double phi[P_MAX] = {0}, f[P_MAX], diagonal[P_MAX], slope[P_MAX];
    for (long k = 0; k < steps; k++) {
        double estimate = regressor(ls->model, p, ls->mass, s, k, state->surge, phi) + dot(p, phi, theta);
        double innovation = s->surge[k] - estimate, gain[P_MAX] = {0}, trace = 0;
        for (int j = 0; j < p; j++) {
            f[j] = 0;
            for (int i = j & -BLOCK; i < rows; i++) f[j] += L[j][i] * phi[i];
        }
        double variance = contraction(p, f, ls->forgetting, diagonal, slope);
        for (int j = p - 1; j >= 0; j--)
            for (int i = j & -BLOCK; i < rows; i++) {
                double old = L[j][i];
                L[j][i] = diagonal[j] * old + slope[j] * gain[i];
                gain[i] += f[j] * old;
                trace += L[j][i] * L[j][i];
            }
        double growth = trace < ls->trace_max * ls->forgetting ? 1 / sqrt(ls->forgetting) : 1;
        for (int j = 0; j < p; j++)
            for (int i = j & -BLOCK; i < rows; i++) L[j][i] *= growth;
        for (int i = 0; i < p; i++) theta[i] += gain[i] * (innovation / variance);
        judge(state, innovation, variance + (1 - ls->forgetting));
        predictions[k] = clamp(estimate, -ls->surge_max, ls->surge_max);
        state->surge = s->surge[k];
    }
}

/* SIFt: before that, L becomes L chol(I + c x x') with x = L^-1 phi and c = (1/lambda - 1)/x'x, and f = L'phi follows.
 * One sweep does both. */
void sift(long steps, const Samples *s, const LeastSquares *ls, LeastSquaresState *state, double *predictions) {
    int p = ls->p, rows = (p + BLOCK - 1) & -BLOCK;
    double(*L)[P_MAX] = state->columns, *theta = state->theta, inverse[P_MAX]; /* of L's diagonal */
    double phi[P_MAX] = {0}, f[P_MAX], x[P_MAX], t[P_MAX + 1] = {1};
    double opens[P_MAX], opening[P_MAX], diagonal[P_MAX], slope[P_MAX];
    for (int j = 0; j < p; j++) inverse[j] = 1 / L[j][j];
    for (long k = 0; k < steps; k++) {
        double estimate = regressor(ls->model, p, ls->mass, s, k, state->surge, phi) + dot(p, phi, theta);
        double innovation = s->surge[k] - estimate, scale = ls->model == SURGE_DYNAMICS ? ls->mass : 1;
        double rest[P_MAX], sum[P_MAX] = {0}, gain[P_MAX] = {0}, below = 0;
        memcpy(rest, phi, sizeof rest);
        for (int j = 0; j < p; j++) {
            x[j] = rest[j] * inverse[j];
            f[j] = 0;
            for (int i = j & -BLOCK; i < rows; i++) {
                f[j] += L[j][i] * phi[i];
                rest[i] -= L[j][i] * x[j];
            }
        }
        judge(state, innovation, 1 + dot(p, f, f));
        predictions[k] = clamp(estimate, -ls->surge_max, ls->surge_max);
        state->surge = s->surge[k];
        double informs = dot(p, phi, phi) * scale * scale;
        if (informs < ls->floor || informs == 0) continue;
        double c = (exp(fmin(s->dt[k] / ls->memory, 20)) - 1) / dot(p, x, x);
        for (int j = 0; j < p; j++) t[j + 1] = t[j] + c * x[j] * x[j];
        rank_one(p, t, x, c, opens, opening);
        for (int j = p - 1; j >= 0; j--) {
            double old = f[j];
            f[j] = opens[j] * old + opening[j] * below;
            below += x[j] * old;
        }
        double variance = contraction(p, f, 1, diagonal, slope);
        for (int j = p - 1; j >= 0; j--)
            for (int i = j & -BLOCK; i < rows; i++) {
                double old = L[j][i], open = opens[j] * old + opening[j] * sum[i];
                L[j][i] = diagonal[j] * open + slope[j] * gain[i];
                sum[i] += x[j] * old;
                gain[i] += f[j] * open;
            }
        for (int j = 0; j < p; j++) inverse[j] = 1 / L[j][j];
        for (int i = 0; i < p; i++) theta[i] += gain[i] * (innovation / variance);
    }
}

/* ---- adaptive identification, AID */

typedef struct {
    int p;
    double mass, surge_max, floor, sigma, bound;
    double gamma[P_MAX];          /* gain times spread squared */
    double inverse_spread[P_MAX]; /* 0 where the spread is 0 */
    double lower[P_MAX], upper[P_MAX];
} Adaptive;

typedef struct {
    double theta[P_MAX]; /* theta_0 = 0 */
    double surge;
} AdaptiveState;

void aid(long steps, const Samples *s, const Adaptive *aid, AdaptiveState *state, double *predictions) {
    int p = aid->p;
    double phi[P_MAX], *theta = state->theta;
    for (long k = 0; k < steps; k++) {
        double estimate = regressor(SURGE_DYNAMICS, p, aid->mass, s, k, state->surge, phi) + dot(p, phi, theta);
        double error = estimate - s->surge[k], N = 0, length = 0, distance = 0;
        for (int i = 0; i < p; i++) {
            N += aid->gamma[i] * phi[i] * phi[i];
            length += phi[i] * phi[i];
        }
        double step = length * aid->mass * aid->mass >= aid->floor ? error / (1 + N) : 0;
        for (int i = 0; i < p; i++) {
            theta[i] = clamp(theta[i] - step * aid->gamma[i] * phi[i], aid->lower[i], aid->upper[i]);
            double n = theta[i] * aid->inverse_spread[i];
            distance += n * n;
        }
        if (distance > aid->bound * aid->bound) { /* nothing leaks below */
            double n = sqrt(distance), rate = aid->sigma * fmin(n / aid->bound - 1, 1);
            double leak = fmin(-expm1(-rate * s->dt[k]), 1 - aid->bound / n);
            for (int i = 0; i < p; i++) theta[i] -= leak * theta[i];
        }
        predictions[k] = clamp(estimate, -aid->surge_max, aid->surge_max);
        state->surge = s->surge[k];
    }
}

/* ---- recurrent network, RNN */

enum { A, W1, HEADING_SIN, HEADING_COS, LEFT, RIGHT, B, ROWS };

typedef struct {
    int n;
    double scale, rate, decay, clip, contraction_rate;
    double ratio[ROWS]; /* of the learning rates */
} Network;

typedef struct {
    double weights[ROWS][N_MAX]; /* by row, so that every loop is over neurons */
    double squares[ROWS][N_MAX]; /* Adam's mean squared gradient */
    double updates, surge;
} NetworkState;

/* theta of (1) in certify/projections.py by Newton's method, which rises to the root of a convex function. */
static inline double threshold(int n, const double *a, const double *cost, double radius) {
    double theta = 0, before = -1;
    while (theta > before) {
        double sum = -radius, squares = 0;
        for (int i = 0; i < n; i++) {
            double on = fabs(a[i]) > theta * cost[i] ? cost[i] : 0;
            sum += on * fabs(a[i]);
            squares += on * on;
        }
        before = theta;
        theta = squares > 0 ? sum / squares : 0;
    }
    return before;
}

/* a goes to the nearest with P, N <= kappa, where P and N sum |a_i w_i| of either sign. */
static inline void project(int n, double *a, const double *w1, double kappa) {
    double costs[2][N_MAX], found[2], radius = kappa * (1 - 8 * n * DBL_EPSILON);
    for (int i = 0; i < n; i++) {
        costs[0][i] = a[i] * w1[i] > 0 ? fabs(w1[i]) : 0;
        costs[1][i] = a[i] * w1[i] > 0 ? 0 : fabs(w1[i]);
    }
    for (int side = 0; side < 2; side++) found[side] = threshold(n, a, costs[side], radius);
    double sums[2] = {0, 0};
    for (int i = 0; i < n; i++) {
        double size = fabs(a[i]) - found[0] * costs[0][i] - found[1] * costs[1][i];
        a[i] = copysign(size > 0 ? size : 0, a[i]);
        sums[0] += costs[0][i] * fabs(a[i]);
        sums[1] += costs[1][i] * fabs(a[i]);
    }
    for (int side = 0; side < 2; side++) sums[side] = sums[side] > radius ? radius / sums[side] : 1; /* rounding */
    for (int i = 0; i < n; i++) a[i] *= costs[0][i] > 0 ? sums[0] : sums[1];
}

void rnn(long steps, const Samples *s, const Network *net, NetworkState *state, double *predictions) {
    int n = net->n;
    double(*w)[N_MAX] = state->weights, (*v)[N_MAX] = state->squares;
    double on[N_MAX], slope[N_MAX], left = pow(0.999, state->updates);
    for (long k = 0; k < steps; k++) {
        double in[ROWS] = {0, net->scale * state->surge, 0.5 + 0.5 * sin(s->heading[k]), 0.5 + 0.5 * cos(s->heading[k]),
                           s->left[k], s->right[k], 1};
        double x = 0, on2 = 0, slope2 = 0;
        for (int i = 0; i < n; i++) {
            double z = 0;
            for (int row = W1; row < ROWS; row++) z += w[row][i] * in[row];
            on[i] = z > 0 ? z : 0;
            slope[i] = z > 0 ? w[A][i] : 0;
            x += w[A][i] * on[i];
            on2 += on[i] * on[i];
            slope2 += slope[i] * slope[i];
        }
        double error = x - net->scale * s->surge[k];
        double norm2 = error * error * (on2 + slope2 * dot(ROWS, in, in)); /* of the gradient */
        double clipped = error / sqrt(1 + norm2 / (net->clip * net->clip));
        double rate = net->rate / sqrt(1 + floor(state->updates / net->decay));
        left *= 0.999;
        double unbiased = 1 / (1 - left);
        for (int row = 0; row < ROWS; row++) {
            double factor = row == A ? clipped : clipped * in[row], step = rate * net->ratio[row];
            const double *each = row == A ? on : slope;
            for (int i = 0; i < n; i++) {
                double g = factor * each[i];
                v[row][i] += (1 - 0.999) * (g * g - v[row][i]);
                w[row][i] -= step * g / (sqrt(v[row][i] * unbiased) + 1e-8);
            }
        }
        project(n, w[A], w[W1], net->contraction_rate);
        predictions[k] = x / net->scale;
        state->updates += 1;
        state->surge = s->surge[k];
    }
}
