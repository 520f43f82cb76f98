/* What the compiled steps of usvlearn are measured against: the same mathematics for one boat, in double precision, as
 * a C programmer would write it. Every sample is fresh and measured; p and n are known at run time only.
 *
 * benchmarks/reference.py compiles and calls it, tests/benchmarks/test_reference.py holds it against the estimators.
 * What is here without a word stands in the docstrings of usvlearn/estimators.
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

/* ---- what the extended Kalman filters share */

enum { FILTER_MAX = 24 }; /* numbers of the state, to whole vectors */

typedef struct {
    double mean[FILTER_MAX], D[FILTER_MAX];
    double columns[FILTER_MAX][FILTER_MAX]; /* of U, unit upper triangular, P = U D U'; zeros elsewhere */
    double noise, updates, turn, deviation, commands[2];
} FilterState;

/* phi_1(z) = (e^z - 1)/z; its derivative cancels near 0, where it is summed. */
static inline double phi1(double z, double *slope) {
    static const double series[14] = {
        1. / 2, 2. / 6, 3. / 24, 4. / 120, 5. / 720, 6. / 5040, 7. / 40320, 8. / 362880, 9. / 3628800, 10. / 39916800,
        11. / 479001600, 12. / 6227020800, 13. / 87178291200, 14. / 1307674368000};
    if (fabs(z) < 0.5) {
        double sum = 0;
        for (int k = 13; k >= 0; k--) sum = sum * z + series[k];
        *slope = sum;
        return (1 - z * sum) / (1 - z);
    }
    double e = exp(z), value = (e - 1) / z;
    *slope = (e - value) / z;
    return value;
}

/* P + c e_k e_k'. */
static inline void widen(double (*U)[FILTER_MAX], double *D, int k, double c) {
    double a[FILTER_MAX] = {0};
    a[k] = 1;
    for (int j = k; j > 0; j--) {
        double larger = D[j] + c * a[j] * a[j], keep = D[j] / larger, beta = c * a[j] / larger, own = a[j];
        for (int i = 0; i < j; i++) {
            double u = U[j][i];
            U[j][i] = u * keep + beta * a[i];
            a[i] -= own * u;
        }
        D[j] = larger;
        c *= keep;
    }
    D[0] += c * a[0] * a[0];
}

/* x_i + sign x_k becomes 0 where it is positive; the others follow their covariances with it. */
static inline void hold(int n, double *x, double (*U)[FILTER_MAX], const double *D, int i, int k, double sign) {
    double value = x[i] + sign * x[k], t[FILTER_MAX], total = 0;
    if (value <= 0) return;
    for (int j = i; j < n; j++) {
        t[j] = U[j][i] + sign * U[j][k];
        total += D[j] * t[j] * t[j];
    }
    for (int j = i; j < n; j++)
        for (int l = 0; l <= j; l++) x[l] -= value / total * D[j] * t[j] * U[j][l];
}

/* At every fourth step one parameter, in turn, gets the noise of all the steps between, up to its prior's variance. */
static inline void walk(int n, int first, FilterState *state, const double *variance, double share, int rest) {
    int m = n - first, place = (int)state->turn;
    if (place % 4 == 0 && !rest) {
        int i = first + place / 4;
        double prior = variance[place / 4], room = prior - state->D[i], growth = 4 * m * share * prior;
        for (int j = i + 1; j < n; j++) room -= state->D[j] * state->columns[j][i] * state->columns[j][i];
        if (room > 0) widen(state->columns, state->D, i, growth < room ? growth : room);
    }
    state->turn = place + 1 < 4 * m ? place + 1 : 0;
}

/* The measurement of x_0 + cosine x_2 + sine x_3 with the innovation `error`, and the noise. */
static inline void correct(int n, FilterState *state, double cosine, double sine, double error, double outlier,
                           int rest) {
    double(*U)[FILTER_MAX] = state->columns, *D = state->D, noise = state->noise;
    double f[FILTER_MAX], G[FILTER_MAX], slope[FILTER_MAX], gain[FILTER_MAX] = {0}, spread = 0;
    for (int j = 0; j < n; j++) {
        f[j] = U[j][0] + cosine * U[j][2] + sine * U[j][3];
        G[j] = D[j] * f[j];
        spread += f[j] * G[j];
    }
    double square = error * error, S = spread + noise, limit = outlier * outlier;
    double alpha = square > limit * S ? square / limit - spread : noise;
    state->deviation = sqrt(S);
    for (int j = 0; j < n; j++) {
        double after = alpha + f[j] * G[j];
        slope[j] = -f[j] / alpha;
        D[j] *= alpha / after;
        alpha = after;
    }
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < ((j + 4) & -4); i++) { /* beyond j all is 0, and stays so; at j, 1 */
            double u = U[j][i];
            U[j][i] = u + gain[i] * slope[j];
            gain[i] += u * G[j];
        }
    }
    for (int i = 0; i < n; i++) state->mean[i] += gain[i] * (error / alpha);
    if (rest) return;
    state->updates += 1;
    noise *= 1 + fmax(0.005, 1 / (state->updates + 20)) * (fmin(square / S, 9) - 1);
    state->noise = fmax(noise, 1e-8);
}

/* ---- joint filter, JointEKF, without readings */

enum { SPEED, FORCE, NORTH, EAST, THETA, KAPPA = 13, EVEN = 15 }; /* places in its state; the last is the lag */

typedef struct {
    int n; /* 16, or 23 with even terms */
    double disturbance, disturbance_time, current, current_time, drift_time, outlier;
    double variance[FILTER_MAX]; /* of the parameters' prior */
} Joint;

/* w+ and its gradient g to the state. */
static inline double flow(int n, const double *x, const double *now, const double *before, double turn, double h,
                          double *g) {
    const double *p = x + THETA, *e = x + EVEN;
    int even = n > 16;
    double w = x[SPEED], mu = x[n - 1], v = fabs(w), sign = w >= 0 ? 1 : -1, xi[2], late = 0, later = 0;
    double f = x[FORCE] + p[0] * v * w + p[1] * w + p[2] * turn * w, J = 2 * p[0] * v + p[1] + p[2] * turn;
    if (even) {
        f += e[0] * w * w;
        J += 2 * e[0] * w;
    }
    for (int k = 0; k < 2; k++) {
        double c = xi[k] = (1 - mu) * now[k] + mu * before[k], size = fabs(c), change = before[k] - now[k];
        const double *a = p + 3 + 3 * k, *b = e + 1 + 3 * k;
        f += c * (a[0] + a[1] * size + a[2] * v + x[KAPPA + k] * c * c);
        J += a[2] * c * sign;
        late += change * (a[0] + 2 * a[1] * size + a[2] * v + 3 * x[KAPPA + k] * c * c);
        later += change * a[2] * sign;
        if (!even) continue;
        f += b[0] * size + b[1] * c * c + b[2] * c * w;
        J += b[2] * c;
        late += change * ((c >= 0 ? b[0] : -b[0]) + 2 * b[1] * c + b[2] * w);
        later += change * b[2];
    }
    double slope, z = fmin(h * J, 1), value = phi1(z, &slope), F = h * value, G = h * h * slope * f;
    g[SPEED] = 1 + z * value + G * 2 * (p[0] * sign + (even ? e[0] : 0));
    g[FORCE] = F;
    g[NORTH] = g[EAST] = 0;
    g[THETA] = F * v * w + 2 * G * v;
    g[THETA + 1] = F * w + G;
    g[THETA + 2] = turn * (F * w + G);
    if (even) g[EVEN] = F * w * w + 2 * G * w;
    for (int k = 0; k < 2; k++) {
        double c = xi[k], size = fabs(c), *a = g + THETA + 3 + 3 * k, *b = g + EVEN + 1 + 3 * k;
        a[0] = F * c;
        a[1] = F * c * size;
        a[2] = c * (F * v + G * sign);
        g[KAPPA + k] = F * c * c * c;
        if (!even) continue;
        b[0] = F * size;
        b[1] = F * c * c;
        b[2] = c * (F * w + G);
    }
    g[n - 1] = F * late + G * later;
    return w + F * f;
}

void joint(long steps, const Samples *s, const Joint *joint, FilterState *state, double *predictions) {
    int n = joint->n;
    double(*U)[FILTER_MAX] = state->columns, *D = state->D, *x = state->mean, g[FILTER_MAX] = {0};
    for (long k = 0; k < steps; k++) {
        double h = s->dt[k], now[2] = {s->left[k], s->right[k]}, noise = state->noise, span = h / 0.4;
        double cosine = cos(s->heading[k]), sine = sin(s->heading[k]);
        int rest = now[0] * now[0] + now[1] * now[1] + x[SPEED] * x[SPEED] <= 1e-3;
        double ahead = flow(n, x, now, state->commands, fabs(s->yaw_rate[k]), h, g);
        if (rest) memset(g + THETA, 0, sizeof g - THETA * sizeof *g);
        double slow = exp(-h / joint->disturbance_time), kept = exp(-h / joint->current_time);
        double scale[4] = {1, slow, kept, kept}, drift = joint->current * joint->current * (1 - kept * kept);
        for (int j = 1; j < n; j++) {
            double sum = 0;
            for (int i = 0; i < ((j + 4) & -4); i++) sum += g[i] * U[j][i];
            for (int i = 1; i < 4 && i < j; i++) U[j][i] *= scale[i] / (j < 4 ? scale[j] : 1);
            U[j][0] = sum / (j < 4 ? scale[j] : 1);
        }
        D[0] *= g[0] * g[0];
        for (int j = 1; j < 4; j++) D[j] *= scale[j] * scale[j];
        widen(U, D, EAST, drift);
        widen(U, D, NORTH, drift);
        widen(U, D, FORCE, joint->disturbance * noise * span);
        D[0] += 0.05 * noise * span;
        walk(n, THETA, state, joint->variance, h / joint->drift_time, rest);
        for (int j = 1; j < 4; j++) x[j] *= scale[j];
        x[SPEED] = ahead;
        memcpy(state->commands, now, sizeof now);
        predictions[k] = ahead + cosine * x[NORTH] + sine * x[EAST];
        correct(n, state, cosine, sine, s->surge[k] - predictions[k], joint->outlier, rest);
        for (int i = THETA; i < THETA + 3; i++) hold(n, x, U, D, i, i, 0);
        if (n > 16)
            for (int sign = 1; sign >= -1; sign -= 2) hold(n, x, U, D, THETA, EVEN, sign);
        x[n - 1] = clamp(x[n - 1], -0.5, 1.5);
    }
}

/* ---- filter of the yaw rate or of the sway, YawEKF and SwayEKF
 *
 * Its samples hold the other one of the two as heading, the surge through the water as yaw rate, and the measured yaw
 * rate or sway as surge.
 */

enum { OWN, SLOW, BIAS, LINEAR, QUADRATIC, CROSS, COUPLING, OTHER, ALONG, SIDE }; /* places; the lag is the last one */

typedef struct {
    int n; /* 22 of the yaw rate, 14 of the sway */
    double disturbance, disturbance_time, drift_time, outlier;
    double variance[FILTER_MAX]; /* of the parameters' prior */
} Axis;

/* y+ and its gradient g to the state. */
static inline double axis_flow(int n, const double *x, const double *now, const double *before, double other, double u,
                               double h, double *g) {
    int yaw = n == 22, terms = yaw ? 6 : 2;
    double y = x[OWN], mu = x[n - 1], size = fabs(y), along = fabs(u), xi[2], late = 0;
    double J = x[LINEAR] + 2 * x[QUADRATIC] * size + x[CROSS] * along;
    double f = x[SLOW] + x[BIAS] + (x[LINEAR] + x[QUADRATIC] * size + x[CROSS] * along) * y;
    f += x[COUPLING] * u * other + x[OTHER] * other + x[ALONG] * u;
    for (int k = 0; k < 2; k++) {
        const double *a = x + SIDE + terms * k;
        double c = xi[k] = (1 - mu) * now[k] + mu * before[k], slope = a[0] + 2 * a[1] * fabs(c);
        f += c * (a[0] + a[1] * fabs(c));
        if (yaw) {
            f += c * (a[2] * along + a[3] * c * c + a[5] * c) + a[4] * fabs(c);
            slope += a[2] * along + 3 * a[3] * c * c + (c >= 0 ? a[4] : -a[4]) + 2 * a[5] * c;
        }
        late += (before[k] - now[k]) * slope;
    }
    double slope, z = fmin(h * J, 1), value = phi1(z, &slope), F = h * value, G = h * h * slope * f;
    g[OWN] = 1 + z * value + G * 2 * x[QUADRATIC] * (y >= 0 ? 1 : -1);
    g[SLOW] = g[BIAS] = F;
    g[LINEAR] = F * y + G;
    g[QUADRATIC] = size * (F * y + 2 * G);
    g[CROSS] = along * (F * y + G);
    g[COUPLING] = F * u * other;
    g[OTHER] = F * other;
    g[ALONG] = F * u;
    for (int k = 0; k < 2; k++) {
        double c = xi[k], *a = g + SIDE + terms * k;
        a[0] = F * c;
        a[1] = F * c * fabs(c);
        if (!yaw) continue;
        a[2] = F * c * along;
        a[3] = F * c * c * c;
        a[4] = F * fabs(c);
        a[5] = F * c * c;
    }
    g[n - 1] = F * late;
    return y + F * f;
}

void axis(long steps, const Samples *s, const Axis *axis, FilterState *state, double *predictions) {
    int n = axis->n;
    double(*U)[FILTER_MAX] = state->columns, *D = state->D, *x = state->mean, g[FILTER_MAX] = {0};
    for (long k = 0; k < steps; k++) {
        double h = s->dt[k], now[2] = {s->left[k], s->right[k]}, u = s->yaw_rate[k], noise = state->noise;
        int rest = now[0] * now[0] + now[1] * now[1] + u * u + x[OWN] * x[OWN] <= 1e-3;
        double ahead = axis_flow(n, x, now, state->commands, s->heading[k], u, h, g);
        if (rest) memset(g + BIAS, 0, sizeof g - BIAS * sizeof *g);
        double slow = exp(-h / axis->disturbance_time), span = h / 0.4;
        for (int j = 1; j < n; j++) {
            double sum = 0;
            for (int i = 0; i < ((j + 4) & -4); i++) sum += g[i] * U[j][i];
            U[j][0] = sum;
            if (j > SLOW) U[j][SLOW] *= slow;
        }
        U[SLOW][0] /= slow;
        D[OWN] *= g[OWN] * g[OWN];
        D[SLOW] *= slow * slow;
        widen(U, D, SLOW, axis->disturbance * noise * span);
        D[OWN] += 0.05 * noise * span;
        walk(n, BIAS, state, axis->variance, h / axis->drift_time, rest);
        x[SLOW] *= slow;
        x[OWN] = predictions[k] = ahead;
        memcpy(state->commands, now, sizeof now);
        correct(n, state, 0, 0, s->surge[k] - ahead, axis->outlier, rest);
        for (int i = LINEAR; i <= CROSS; i++) hold(n, x, U, D, i, i, 0);
        x[n - 1] = clamp(x[n - 1], -0.5, 1.5);
    }
}
