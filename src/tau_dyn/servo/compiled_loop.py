"""The servo loops of `loop.py` as compiled code: the same equations, up to eight trials side by side, a hundred times faster.

The source is C99, built once and kept (`equations/compiler.py`). Without a compiler, or with `TAU_DYN_COMPILE=0`, `loop.py` steps
all trials at once in numpy; both agree to rounding.
"""

from __future__ import annotations

import ctypes
from functools import partial

import numpy as np

from tau_dyn.equations import LibraryCache, is_compiling_allowed
from tau_dyn.servo.waves import LoadRows, Trials, Waves
from tau_dyn.simulate import COMMANDS, SERVO_ENTRIES

NAMES = (*SERVO_ENTRIES, "armature", "coulomb", "viscous", "offset")
"""Numbers of a joint in the order of the kernel's arguments."""
LANES = 8
"""Largest number of trials of a joint, or of joints of a trial, that are stepped side by side."""
_WIDTHS = (1, 4, LANES)  # libraries' lanes; few trials take the narrow ones
_LIBRARIES = LibraryCache()
_SETTLE = ctypes.CFUNCTYPE(ctypes.c_int64, *(4 * [ctypes.c_int64]))

_SOURCE = r"""
/* No option changes a result: lanes are stepped side by side by wide instructions where the machine has them */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("O3", "no-math-errno", "no-trapping-math")
#endif
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif
enum {@NAMES@, COUNT};
enum {POSITION, SPEED, OUTPUT};
enum {LANES = @LANES@};
#if defined(__GNUC__) && !defined(__clang__)
#define RANGE(n, from, to) _Pragma("GCC unroll 1") for (int n = from; n < to; n++)  /* unrolled loops do not become wide ones */
#else
#define RANGE(n, from, to) for (int n = from; n < to; n++)
#endif
#define EACH(n) RANGE(n, 0, LANES)
typedef double lanes_t[LANES];
typedef struct {double position, speed;} goal_t;

INLINE double least_of(double a, double b) {return a < b ? a : b;}
INLINE double most_of(double a, double b) {return a > b ? a : b;}
INLINE double clip(double x, double low, double high) {return least_of(most_of(x, low), high);}

/* Mean goal over a step: the delayed command is `before` for a part of it, then `first` */
static double follow(goal_t *g, double first, double before, double part, double limit, double speed, double h,
    int64_t finer, int passes) {
  if (passes) {g->speed = 0.0; g->position = first; return first + part * (before - first);}
  h /= (double)finer;
  int bounded = isfinite(limit);
  double half = bounded ? 0.5 * limit * h : 0.0, total = 0.0;  /* change of speed in half a step */
  for (int64_t n = 0; n < finer; n++) {
    double target = first + clip(part * (double)finer - (double)n, 0.0, 1.0) * (before - first);
    double distance = target - g->position, apart = fabs(distance), way = distance > 0 ? 1.0 : distance < 0 ? -1.0 : 0.0;
    if (bounded && apart <= 2.0 * half * h && fabs(g->speed) <= 4.0 * half) {
      g->speed = 0.0; g->position = target; total += target;
      continue;
    }
    double room = most_of(apart - 0.5 * h * way * g->speed, 0.0);  /* left after the step if it ends at rest */
    double wanted = way * least_of(bounded ? sqrt(half * half + 2.0 * limit * room) - half : apart / h, speed);
    double after = bounded ? g->speed + clip(wanted - g->speed, -2.0 * half, 2.0 * half) : wanted;
    double step = h * (bounded ? 0.5 * (g->speed + after) : after);
    total += g->position + 0.5 * step;
    g->position += step; g->speed = after;
  }
  return total / (double)finer;
}

/* Mean goals of all steps of one joint of one log, and what they depend on: trials that share it share the goals */
typedef struct {int64_t joint, log; double delay, step, limit, speed, passes, *at;} goals_t;

static int is_goal_of(const goals_t *x, const goals_t *y) {
  return x->joint == y->joint && x->log == y->log && x->delay == y->delay && x->step == y->step && x->limit == y->limit
    && x->speed == y->speed && x->passes == y->passes;
}

static void fill_goals(const goals_t *x, int64_t N, int64_t often, double h, int64_t finer, int told, const double *cmd,
    const double *makes_step) {
  double late = x->delay / h, whole = floor(late), part = late - whole;
  int64_t behind = (int64_t)whole, here = 0, here_step = 0, there = 0, there_step = 0;
  int profiled = told == POSITION && (isfinite(x->speed) || isfinite(x->limit));
  if (behind < 0) {
    here = -behind / often; here_step = -behind % often;
    there = (-behind - 1) / often; there_step = (-behind - 1) % often;
  }
  goal_t g = {x->step > 0 ? x->step * nearbyint(cmd[0] / x->step) : cmd[0], 0.0};
  for (int64_t at = 0; at < (N - 1) * often; at++) {
    int64_t one = at - behind, now = one < 0 ? 0 : here < N ? here : N - 1, then = one < 1 ? 0 : there < N ? there : N - 1;
    double first = cmd[now], before = cmd[then];
    if (one >= 0 && ++here_step == often) {here_step = 0; here++;}
    if (one >= 1 && ++there_step == often) {there_step = 0; there++;}
    if (x->step > 0) {first = x->step * nearbyint(first / x->step); before = x->step * nearbyint(before / x->step);}
    x->at[at] = first + part * (before - first);
    if (profiled) {
      int passes = makes_step[now] > 0 || (makes_step[then] > 0 && first == before);
      x->at[at] = follow(&g, first, before, part, x->limit, x->speed, h, finer, passes && x->passes > 0);
    }
  }
}

/* Exact step of the twist between two masses: a and S of  S D+ = a S D - K d + force  (see loop.py) */
static void spring(double K, double damping, double mu, double h, double *a, double *S) {
  double w2 = K / mu * h * h, sigma = 0.5 * damping / mu * h;
  double late = sigma + most_of(0.0, sqrt(w2) - 1.0), turn = w2 - sigma * sigma, T;
  double E = exp(-2.0 * late);
  if (turn > 0) T = 2.0 * exp(-late) * cos(least_of(sqrt(turn), 3.14159265358979323846));
  else T = exp(sqrt(-turn) - late) + exp(-sqrt(-turn) - late);
  *a = 0.5 * (T + E - 1.0);
  *S = K * h / (E - T + 1.0);
}

/* Takes loads along the motion between two samples of a log; nonzero where the motion is that of the loads already */
typedef int64_t (*settle_t)(int64_t log, int64_t begin, int64_t stop, int64_t turn);

/* Lanes stepped side by side: trials of one joint of one log, or, with coupling, the joints of one trial. A rigid joint's motor
   moves as its link. Numbers, waves, state, and what holds over a sample and over a step */
typedef struct {
  double p[COUNT][LANES], h, *past[LANES];
  int64_t length[LANES];
  int elastic[LANES], n_elastic, late, bent, sticky, loops, integrates;  /* whether any lane has it */
  int one_goal;
  const double *goals[LANES], *way[LANES], *stiff[LANES], *ld[LANES], *in[LANES];
  double *shown[LANES];
  lanes_t q, v, m, w, v_before, integral, next_load, mass, last, old_part, fades;
  /* total is h over both inertias, S and open are the inverse steps of the twist's rate, firm and loose inverse mobilities */
  lanes_t total, share, a, S, stuck, open, firm, loose, gap;
  /* loaded: the link's inertia while the other joints give way */
  lanes_t rest0, slope, turn, way_now, stiff_now, full, loaded, last_loaded;
  lanes_t push, damping, friction, rest, q_next, v_next, m_next, w_next;
} block_t;

/* exp(x) for x <= 0 */
INLINE double decay(double x) {
  x = most_of(x, -700.0);
  double t = x * 1.4426950408889634 + 6755399441055744.0, k = t - 6755399441055744.0;  /* the sum rounds to an integer */
  double r = (x - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10, y = 1.0 / 6227020800.0;
  y = y * r + 1.0 / 479001600.0; y = y * r + 1.0 / 39916800.0; y = y * r + 1.0 / 3628800.0; y = y * r + 1.0 / 362880.0;
  y = y * r + 1.0 / 40320.0; y = y * r + 1.0 / 5040.0; y = y * r + 1.0 / 720.0; y = y * r + 1.0 / 120.0;
  y = y * r + 1.0 / 24.0; y = y * r + 1.0 / 6.0; y = y * r + 0.5; y = y * r + 1.0; y = y * r + 1.0;
  union {double x; uint64_t bits;} power = {t};
  power.bits = (power.bits + 1023) << 52;  /* the integer is in the last bits */
  return y * power.x;
}

/* What the law and the friction do over a step, and its load at the middle: from the state before it */
INLINE void drive(block_t *x, int64_t at, int64_t i, int on_motor, int told, double supply, double straight) {
  double (*p)[LANES] = x->p, h = x->h, half = 0.5 * h, late = (double)i + 0.5;
  const double *seen = on_motor ? x->m : x->q, *seen_speed = on_motor ? x->w : x->v, *turning = x->w;
  lanes_t goal, e, u, slow, loses, y, push, lever;
  if (x->one_goal) {double one = x->goals[0][at]; EACH(n) goal[n] = one;} else EACH(n) goal[n] = x->goals[n][at];
  EACH(n) slow[n] = 0.0;
  if (told == POSITION) EACH(n) {
    double apart = goal[n] - (seen[n] + half * seen_speed[n]), band = p[dead_band][n];
    double left = copysign(most_of(fabs(apart) - band, 0.0), apart);
    e[n] = band > 0 ? left : apart;
    u[n] = p[position_gain][n] * e[n] - p[derivative_gain][n] * seen_speed[n];
  } else EACH(n) e[n] = u[n] = goal[n];
  if (told != OUTPUT && x->loops) EACH(n) {  /* a loop of speed, alone or inside that of position */
    double gain = p[speed_gain][n], wanted = clip(u[n], -p[speed_limit][n], p[speed_limit][n]) - seen_speed[n];
    double error = e[n], force = u[n], mine = gain * wanted;
    e[n] = gain > 0 ? wanted : error; u[n] = gain > 0 ? mine : force; slow[n] = gain > 0 ? gain : 0.0;
  }
  if (told != OUTPUT && x->integrates) EACH(n) {  /* to the middle; a speed's error over the last step is known by now */
    double inner = p[speed_integral_gain][n], outer = p[integral_gain][n], has = p[speed_gain][n], most = p[limit][n];
    double gain = has > 0 ? inner : outer, more = half * gain * (seen_speed[n] - x->v_before[n]);
    double sum = x->integral[n] - (has > 0 ? more : 0.0);
    x->v_before[n] = seen_speed[n];
    u[n] += clip(sum + half * gain * e[n], -most, most);
    x->integral[n] = clip(sum + gain * h * e[n], -most, most);
  }
  EACH(n) {
    /* what torque is lost per unit of speed; a loop of speed's part where it acts at once and is not at its limit */
    double most = p[limit][n], late = p[torque_delay][n], at_once = supply * slow[n];
    int acts = (late <= 0) & (fabs(u[n]) < most);
    loses[n] = p[back_emf][n] + (acts ? at_once : 0.0);
    u[n] = clip(u[n], -most, most);
    u[n] = u[n] * (1.0 - p[supply_sag][n] * fabs(u[n]));
  }
  if (x->late) EACH(n) if (x->past[n]) {
    double *past = x->past[n];
    int64_t length = x->length[n];
    if (at == 0) for (int64_t j = 0; j < length; j++) past[j] = u[n];
    past[at % length] = u[n];
    double newer = past[(at + 2) % length], older = past[(at + 1) % length];
    u[n] = newer + x->old_part[n] * (older - newer);
  }
  EACH(n) {
    y[n] = u[n] * supply - p[back_emf][n] * turning[n];
    push[n] = x->full[n] * y[n]; lever[n] = x->full[n] * loses[n];
  }
  if (x->bent) EACH(n) if (p[drive_exponent][n] != 1.0) {
    double grown = x->full[n] * pow(most_of(fabs(y[n]), straight), p[drive_exponent][n] - 1.0);
    push[n] = grown * y[n];
    lever[n] = grown * (fabs(y[n]) > straight ? p[drive_exponent][n] : 1.0) * loses[n];
  }
  EACH(n) {
    double brake = p[braking][n], brakes = y[n] * u[n] < 0 ? brake : 1.0;
    push[n] *= brakes;
    x->rest[n] = x->rest0[n] + late * x->slope[n]
      + x->stiff_now[n] * (x->q[n] + half * x->v[n] - x->way_now[n] - late * x->turn[n]);
    x->damping[n] = 0.5 * (lever[n] * brakes + p[viscous][n]);
    x->friction[n] = p[coulomb][n] + p[load_friction][n] * fabs(push[n]) + p[carried_friction][n] * fabs(x->rest[n]);
    x->push[n] = push[n] + (x->damping[n] - p[viscous][n]) * turning[n];
  }
  if (x->sticky) EACH(n) x->friction[n] += p[stiction][n] * decay(-fabs(turning[n]) * x->fades[n]);
}

/* The state of rigid lanes after a step under loads */
INLINE void turn_rigid(block_t *restrict x, int from, int to, const double *restrict rest) {
  double (*p)[LANES] = x->p, half = 0.5 * x->h;
  lanes_t wanted, after, path;
  int stop = 0, sticky = x->sticky;
  RANGE(n, from, to) {
    double v = x->v[n], friction = x->friction[n];
    wanted[n] = x->firm[n] * v + x->push[n] - rest[n];
    after[n] = (wanted[n] - (v > 0 ? friction : -friction)) / (x->firm[n] + x->damping[n]);
    path[n] = v + after[n];
    stop |= after[n] * v <= 0;
  }
  if (stop) RANGE(n, from, to) {  /* at rest, or comes to rest after a part of the step */
    double v = x->v[n], friction = x->friction[n], moving = v != 0 ? v / (v - after[n]) : 0.0;
    double left = wanted[n] - (x->firm[n] - x->damping[n]) * v;
    if (sticky) friction += v != 0 ? p[stiction][n] * (1.0 - decay(-fabs(v) * x->fades[n])) : 0.0;
    double end = (left - clip(left, -friction, friction)) / (x->firm[n] / (1.0 - moving) + x->damping[n]);
    int stops = after[n] * v <= 0;
    path[n] = stops ? moving * v + (1.0 - moving) * end : path[n];
    after[n] = stops ? end : after[n];
  }
  RANGE(n, from, to) {
    x->q_next[n] = x->m_next[n] = x->q[n] + half * path[n];
    x->v_next[n] = x->w_next[n] = after[n];
  }
}

/* The state of a lane with a spring or a play after a step under a load */
static void turn_elastic(block_t *x, int n, double rest) {
  double half = 0.5 * x->h, friction = x->friction[n], damping = x->damping[n], v = x->v[n], w = x->w[n];
  double twist = x->m[n] - x->q[n], rate = w - v, pull = 0.0, A = 1.0, S_now = x->open[n], inverse = x->loose[n];
  double share = x->share[n], gap = x->gap[n];
  if (fabs(twist) >= gap) {
    pull = x->stuck[n] * (twist - (twist > 0 ? gap : -gap)); A = x->a[n]; S_now = x->S[n]; inverse = x->firm[n];
  }
  double base = A * rate + ((1.0 - share) * rest - pull) * S_now, common = w - share * rate - x->total[n] * rest;
  double wanted = (common + share * base) * inverse + x->push[n];
  double left = wanted - clip(wanted, -friction, friction);
  x->w_next[n] = left / (inverse + damping);
  double motor_force = left - damping * x->w_next[n] - (common + share * base) * inverse;
  x->v_next[n] = x->w_next[n] - base - share * motor_force * S_now;
  x->m_next[n] = x->m[n] + half * (w + x->w_next[n]); x->q_next[n] = x->q[n] + half * (v + x->v_next[n]);
}

static void take_inertia(block_t *x, int n, double least, double contact, double teeth) {
  double (*p)[LANES] = x->p, h = x->h;
  if (x->mass[n] == x->last[n] && x->loaded[n] == x->last_loaded[n]) return;
  x->last[n] = x->mass[n]; x->last_loaded[n] = x->loaded[n];
  double motor = most_of(p[armature][n], least), link = most_of(x->mass[n], least), mu, share;
  x->total[n] = h / (motor + link); share = x->share[n] = link / (motor + link); mu = motor * share;
  int has_spring = p[joint_compliance][n] > 0;
  double stuck = x->stuck[n] = has_spring ? 1.0 / p[joint_compliance][n] : mu * (contact / h) * (contact / h);
  /* the coupling itself takes `more` off the twist's inertia over the step */
  double gives = has_spring ? clip(x->loaded[n], least, link) : link;
  double mine = motor * gives / (motor + gives), more = (mu - mine) / h;
  double critical = 2.0 * sqrt(stuck * mine), slack = x->gap[n] > 0 ? teeth * critical : 0.0, a, S;
  spring(stuck, has_spring ? most_of(p[joint_damping][n], slack) : critical, mine, h, &a, &S);
  x->a[n] = (a * S + more) / (S + more); S += more;
  x->S[n] = 1.0 / S; x->open[n] = h / mu;
  x->firm[n] = 1.0 / (x->total[n] + share * share * x->S[n]); x->loose[n] = 1.0 / (x->total[n] + share * share * x->open[n]);
}

/* Inertias of links behind springs while the other joints give way: the inverse of the inverse mass matrix's diagonal, with the
   drives of rigid joints on their links */
static void take_loaded_inertias(block_t *all, int64_t J, const double *M, double *y, double *A) {
  for (int64_t n = 0; n < J; n++) for (int64_t j = 0; j <= n; j++) {
    const block_t *x = all + n / LANES;
    int rigid = n == j && !x->elastic[n % LANES];
    double sum = M[n * J + j] + (rigid ? x->p[armature][n % LANES] : 0.0), own = sum;
    for (int64_t i = 0; i < j; i++) sum -= A[n * J + i] * A[j * J + i];
    A[n * J + j] = j < n ? sum / A[j * J + j] : sqrt(most_of(sum, 1e-9 * own));
  }
  for (int64_t n = 0; n < J; n++) {
    double square = 0.0;
    for (int64_t j = n; j < J; j++) {
      double sum = n == j;
      for (int64_t i = n; i < j; i++) sum -= A[j * J + i] * y[i];
      y[j] = sum / A[j * J + j]; square += y[j] * y[j];
    }
    all[n / LANES].loaded[n % LANES] = 1.0 / square;
  }
}

static void show(block_t *x, int lanes, int64_t k, int64_t plane, int on_motor, int with_speeds) {
  const double *measured = on_motor ? x->m : x->q;
  for (int n = 0; n < lanes; n++) {
    x->shown[n][k] = measured[n];
    if (with_speeds) {x->shown[n][k + plane] = x->q[n]; x->shown[n][k + 2 * plane] = x->v[n];}
  }
}

/* Speeds' changes d of joints that slide on while the others rest: (M / h + own) d = force, by Cholesky */
static void guess_changes(const block_t *all, int64_t J, const double *M, double *d, double *A) {
  double h = all->h;
  for (int64_t n = 0; n < J; n++) {
    const block_t *x = all + n / LANES;
    int l = (int)(n % LANES);
    if (x->elastic[l]) continue;
    double *row = A + n * J, own = x->firm[l] + x->damping[l], v = x->v[l];
    d[n] = v == 0 ? 0.0 : x->push[l] - x->rest[l] - (v > 0 ? x->friction[l] : -x->friction[l]) - x->damping[l] * v;
    for (int64_t j = 0; j <= n; j++) {
      const block_t *other = all + j / LANES;
      int rests = v == 0 || other->v[j % LANES] == 0 || other->elastic[j % LANES];
      row[j] = rests ? 0.0 : M[n * J + j] / h;
    }
    row[n] = own;
    for (int64_t j = 0; j <= n; j++) {
      if (all[j / LANES].elastic[j % LANES]) continue;
      double sum = row[j];
      for (int64_t i = 0; i < j; i++) if (!all[i / LANES].elastic[i % LANES]) sum -= row[i] * A[j * J + i];
      if (j < n) row[j] = sum / A[j * J + j];
      else row[n] = sqrt(most_of(sum, 1e-12 * own));
    }
    for (int64_t j = 0; j < n; j++) if (!all[j / LANES].elastic[j % LANES]) d[n] -= row[j] * d[j];
    d[n] /= row[n];
  }
  for (int64_t n = J - 1; n >= 0; n--) if (!all[n / LANES].elastic[n % LANES]) {
    for (int64_t j = n + 1; j < J; j++) if (!all[j / LANES].elastic[j % LANES]) d[n] -= A[j * J + n] * d[j];
    d[n] /= A[n * J + n];
  }
}

/* A step of all joints by projected Gauss-Seidel: each one's load grows as the others' speeds change */
static void turn_together(block_t *all, int64_t J, double *M, int64_t i, int64_t sweeps, double settled) {
  double h = all->h, late = (double)i + 0.5, *G = M + J * J, *d = G + J * J;
  for (int64_t n = 0; n < J; n++) {
    const block_t *x = all + n / LANES;
    int l = (int)(n % LANES);
    double apart = x->q[l] + 0.5 * h * x->v[l] - x->way_now[l] - late * x->turn[l];
    for (int64_t j = 0; j < J; j++) if (j != n) all[j / LANES].rest[j % LANES] += G[j * J + n] * apart;
  }
  for (int64_t n = 0; n < J; n++) d[n] = all[n / LANES].v_next[n % LANES];  /* springs change as in the step before */
  guess_changes(all, J, M, d, d + J);
  for (int64_t turns = 0; turns < sweeps; turns++) {
    double most = 0.0;
    for (int64_t n = 0; n < J; n++) {
      block_t *x = all + n / LANES;
      int l = (int)(n % LANES);
      double pull = -M[n * J + n] * d[n];
      for (int64_t j = 0; j < J; j++) pull += M[n * J + j] * d[j];
      lanes_t rest;
      rest[l] = x->rest[l] + pull / h;
      if (x->elastic[l]) turn_elastic(x, l, rest[l]); else turn_rigid(x, l, l + 1, rest);
      double change = x->v_next[l] - x->v[l];
      most = most_of(most, fabs(change - d[n]));
      d[n] = change;
    }
    if (!(most > settled)) return;
  }
}

/* Positions at stamps `apart` steps from the clock, by the parabola through three samples */
static void move_to_stamps(double *q, int64_t N, const double *apart) {
  double before = q[0];
  for (int64_t k = 0; k < N; k++) {
    double now = q[k], after = q[k + 1 < N ? k + 1 : k];
    q[k] = now + 0.5 * apart[k] * (after - before + apart[k] * (after - 2.0 * now + before));
    before = now;
  }
}

WIDE static int64_t run(const int64_t *size, const double *dt, const double *start, const double *speed, const double *command,
    const double *makes_step, const double *along, const double *load,
    const double *load_by, const double *inertia, const double *inertia_by,
    const double *stiffness, const double *supply, const double *enabled, const double *entries, const double *inertial,
    const double *limits, const double *masses, const double *slopes, const double *apart, const double *shown, double *out,
    settle_t settle) {
  int64_t N = size[0], J = size[1], C = size[2], L = size[3], K = size[4], often = size[5], every = size[10], R = size[11];
  int on_motor = (int)size[6], shown_on_motor = (int)size[7], held_load = (int)size[8], with_speeds = (int)size[9];
  int64_t window = size[12], sweeps = size[13], chosen = size[17], failed = 0;
  int told = (int)size[14], moves = (int)size[16];
  int64_t plane = J * C * L * N, n_blocks = every ? (J + LANES - 1) / LANES : 1, rows = every ? J : LANES + 1;
  double share = 1.0 / (double)often;
  double least = limits[0], straight = limits[1], contact = limits[2], teeth = limits[3], settled = limits[4];
  block_t *all = calloc(2 * (size_t)n_blocks, sizeof(block_t)), *kept = all + n_blocks;
  double *M = malloc((size_t)(3 * J * J + J) * sizeof(double)), *G = M + J * J;  /* and room for a step */
  lanes_t *changes = malloc((size_t)(K + 1) * sizeof(lanes_t));
  int64_t *which = malloc((size_t)(K + 1) * sizeof(int64_t));
  goals_t *goals = malloc((size_t)rows * sizeof(goals_t));
  double *sought = malloc((size_t)(rows * N * often) * sizeof(double));
  double *whole = malloc((size_t)(LANES * N) * sizeof(double));  /* all positions, of which some are returned */
  if (!all || !M || !changes || !which || !goals || !sought || !whole) failed = 1;
  else for (int64_t n = 0; n < rows; n++) goals[n] = (goals_t){-1, -1, 0.0, 0.0, 0.0, 0.0, 0.0, sought + n * N * often};
  for (int64_t s = 0; s < L && !failed; s++) for (int64_t j0 = 0; j0 < J && !failed; j0 += every ? J : 1)
  for (int64_t c0 = 0; c0 < C && !failed; c0 += every ? 1 : LANES) {
    const double *sup = supply + s * N, *en = enabled + s * N;
    int64_t used = every ? J : C - c0 < LANES ? C - c0 : LANES, moved = 0, last = N;
    for (int64_t k = 0; k < chosen; k++) {  /* no log is simulated beyond the last position that is returned */
      int64_t end = (int64_t)shown[s * chosen + k] + 2;
      if (k == 0 || end > last) last = end;
    }
    if (last > N) last = N;
    for (int64_t i = 0; i < K; i++) {  /* inertial unknowns that differ from the waves' own in any lane */
      int any = 0;
      EACH(n) {changes[moved][n] = n < used ? inertial[i * C + c0 + n] : 0.0; any |= changes[moved][n] != 0.0;}
      if (any) which[moved++] = i;
    }
    for (int64_t n = 0; n < n_blocks * LANES; n++) {  /* unused lanes repeat the first one */
      block_t *x = all + n / LANES;
      int l = (int)(n % LANES), in_use = n < used;
      int64_t j = every && in_use ? n : j0, c = !every && in_use ? c0 + n : c0, row = (j * L + s) * N;
      double (*p)[LANES] = x->p, h = x->h = dt[s] / (double)often;
      if (!l) {x->n_elastic = x->late = x->bent = x->sticky = x->loops = x->integrates = 0; x->one_goal = 1;}
      for (int i = 0; i < COUNT; i++) p[i][l] = entries[((i * J + j) * C + c) * L + s];
      goals_t goal = {j, s, p[command_delay][l], p[command_step][l], p[acceleration_limit][l], p[speed_limit][l],
        p[steps_pass][l], NULL};
      goals_t *first = every ? goals + j : goals + LANES, *mine = every ? first : goals + l;  /* `first`: of the first trial */
      if (first->joint != j || first->log != s || is_goal_of(first, &goal)) mine = first;
      if (!is_goal_of(mine, &goal)) {
        goal.at = mine->at; *mine = goal;
        fill_goals(mine, N, often, h, size[15], told, command + row, makes_step + row);
      }
      x->goals[l] = mine->at; x->one_goal &= x->goals[l] == x->goals[0];
      x->way[l] = along + row; x->stiff[l] = stiffness + row; x->ld[l] = load + row; x->in[l] = inertia + row;
      x->shown[l] = !in_use ? NULL : chosen ? whole + l * N : out + ((j * C + c) * L + s) * N;
      double old = p[torque_delay][l] / h, old_whole = floor(old);
      x->old_part[l] = old - old_whole; x->length[l] = (int64_t)old_whole + 2;
      int delayed = p[torque_delay][l] > 0 && in_use;
      x->past[l] = delayed ? malloc(2 * (size_t)x->length[l] * sizeof(double)) : NULL;
      if (delayed && !x->past[l]) failed = 1;
      x->elastic[l] = p[joint_compliance][l] > 0 || p[backlash][l] > 0;
      x->n_elastic += x->elastic[l]; x->late |= delayed; x->bent |= p[drive_exponent][l] != 1.0;
      x->sticky |= p[stiction][l] != 0; x->loops |= p[speed_gain][l] > 0;
      x->integrates |= (p[speed_gain][l] > 0 ? p[speed_integral_gain][l] : p[integral_gain][l]) != 0;
      x->fades[l] = 1.0 / most_of(p[stiction_speed][l], 1e-30);
      x->gap[l] = 0.5 * p[backlash][l]; x->integral[l] = 0.0; x->last[l] = -1.0;
      x->q[l] = x->m[l] = start[j * L + s]; x->v[l] = x->w[l] = x->v_before[l] = speed[j * L + s];
      x->v_next[l] = 0.0;  /* between steps, what the last one changed */
      x->q_next[l] = x->m_next[l] = x->q[l]; x->w_next[l] = 0.0;
      x->next_load[l] = x->ld[l][0];
      for (int64_t i = 0; i < moved; i++) x->next_load[l] += load_by[row * K + which[i]] * changes[i][l];
      if (x->elastic[l]) {
        double rest0 = x->next_load[l] + p[offset][l];
        double twist = p[joint_compliance][l] * rest0 + (rest0 > 0 ? x->gap[l] : rest0 < 0 ? -x->gap[l] : 0.0);
        if (shown_on_motor) x->q[l] -= twist; else x->m[l] += twist;
      }
    }
    int64_t step = every ? window : N;
    for (int64_t begin = 0; begin < N && !failed; begin += step) {
      int64_t stop = begin + step < last - 1 ? begin + step : last - 1, turn = 0;
      for (int64_t b = 0; b < n_blocks; b++) {
        block_t *x = all + b;
        kept[b] = *x;
        EACH(n) if (x->past[n]) memcpy(x->past[n] + x->length[n], x->past[n], (size_t)x->length[n] * sizeof(double));
        show(x, (int)least_of((double)(used - b * LANES), LANES), begin, plane, shown_on_motor, with_speeds);
      }
      if (every && begin < stop && settle(s, begin, stop, turn)) break;
      while (begin < stop) {
        for (int64_t k = begin; k < stop; k++) {
          for (int64_t b = 0; b < n_blocks; b++) {
            block_t *x = all + b;
            lanes_t now;
            if (every) EACH(n) {
              now[n] = held_load ? x->ld[n][k] : x->next_load[n];
              x->mass[n] = x->in[n][k]; x->next_load[n] = x->ld[n][k + 1];
              x->way_now[n] = x->way[n][k]; x->turn[n] = (x->way[n][k + 1] - x->way[n][k]) / (double)often;
              x->stiff_now[n] = x->stiff[n][k];
            } else {  /* lanes of one joint of one log */
              double mass0 = x->in[0][k], load0 = x->ld[0][k], load1 = x->ld[0][k + 1], way0 = x->way[0][k];
              double turn0 = (x->way[0][k + 1] - way0) / (double)often, stiff0 = x->stiff[0][k];
              EACH(n) {
                now[n] = held_load ? load0 : x->next_load[n];
                x->mass[n] = mass0; x->next_load[n] = load1; x->way_now[n] = way0; x->turn[n] = turn0; x->stiff_now[n] = stiff0;
              }
            }
            const double *inb = inertia_by + ((j0 * L + s) * N + k) * K, *ldb = load_by + ((j0 * L + s) * N + k + 1) * K;
            for (int64_t i = 0; i < moved; i++) {
              double heavy = inb[which[i]], pulls = ldb[which[i]];
              EACH(n) {x->mass[n] += heavy * changes[i][n]; x->next_load[n] += pulls * changes[i][n];}
            }
            EACH(n) {
              x->rest0[n] = now[n] + x->p[offset][n];
              x->slope[n] = held_load ? 0.0 : (x->next_load[n] - now[n]) * share;
              x->full[n] = x->p[force_per_unit][n] * en[k];
              x->loaded[n] = x->mass[n];
            }
          }
          if (every) {  /* mass matrix and slopes of gravity between their rows */
            const double *m0 = masses + (s * R + k / every) * J * J, *g0 = slopes + (s * R + k / every) * J * J;
            double part = (double)(k % every) / (double)every;
            for (int64_t n = 0; n < J * J; n++) {
              M[n] = m0[n] + part * (m0[n + J * J] - m0[n]);
              G[n] = g0[n] + part * (g0[n + J * J] - g0[n]);
            }
            take_loaded_inertias(all, J, M, G + J * J, G + J * J + J);
          }
          for (int64_t b = 0; b < n_blocks; b++) {
            block_t *x = all + b;
            if (x->n_elastic < LANES) {
              lanes_t firm;
              double rate = 1.0 / x->h;
              EACH(n) firm[n] = most_of(x->mass[n] + x->p[armature][n], least) * rate;
              EACH(n) x->firm[n] = x->elastic[n] ? x->firm[n] : firm[n];
            }
            if (x->n_elastic) EACH(n) if (x->elastic[n]) take_inertia(x, n, least, contact, teeth);
          }
          for (int64_t i = 0; i < often; i++) {
            for (int64_t b = 0; b < n_blocks; b++) drive(all + b, k * often + i, i, on_motor, told, sup[k], straight);
            if (every) turn_together(all, J, M, i, sweeps, settled);
            else {
              if (all->n_elastic < LANES) {lanes_t rest; memcpy(rest, all->rest, sizeof(rest)); turn_rigid(all, 0, LANES, rest);};
              if (all->n_elastic) EACH(n) if (all->elastic[n]) turn_elastic(all, n, all->rest[n]);
            }
            for (int64_t b = 0; b < n_blocks; b++) {
              block_t *x = all + b;
              EACH(n) {
                double gained = x->v_next[n] - x->v[n];
                x->q[n] = x->q_next[n]; x->v[n] = x->v_next[n]; x->m[n] = x->m_next[n]; x->w[n] = x->w_next[n];
                x->v_next[n] = gained;
              }
            }
          }
          for (int64_t b = 0; b < n_blocks; b++)
            show(all + b, (int)least_of((double)(used - b * LANES), LANES), k + 1, plane, shown_on_motor, with_speeds);
        }
        if (!every || settle(s, begin, stop, ++turn)) break;
        for (int64_t b = 0; b < n_blocks; b++) {
          block_t *x = all + b;
          *x = kept[b];
          EACH(n) if (x->past[n]) memcpy(x->past[n], x->past[n] + x->length[n], (size_t)x->length[n] * sizeof(double));
        }
      }
    }
    for (int64_t n = 0; n < used; n++) {
      free(all[n / LANES].past[n % LANES]);
      double *q = all[n / LANES].shown[n % LANES], *picked = out + ((j0 * C + c0 + n) * L + s) * chosen;
      if (moves && !failed) move_to_stamps(q, last, apart + s * N);
      for (int64_t k = 0; k < chosen && !failed; k++) picked[k] = q[(int64_t)shown[s * chosen + k]];
    }
  }
  free(all); free(M); free(changes); free(which); free(goals); free(sought); free(whole);
  return failed;
}

__attribute__((visibility("default")))
int64_t loop_run(const int64_t *size, const double *dt, const double *start, const double *speed, const double *command,
    const double *makes_step, const double *along, const double *load,
    const double *load_by, const double *inertia, const double *inertia_by,
    const double *stiffness, const double *supply, const double *enabled, const double *entries, const double *inertial,
    const double *limits, const double *masses, const double *slopes, const double *apart, const double *shown, double *out,
    settle_t settle) {
  return run(size, dt, start, speed, command, makes_step, along, load, load_by, inertia, inertia_by, stiffness, supply, enabled,
    entries, inertial, limits, masses, slopes, apart, shown, out, settle);
}
"""


def run_compiled(
    waves: Waves, trials: Trials, often: int, limits: tuple[float, ...], sweeps: int, motion: bool
) -> np.ndarray | None:
    """Return the result of `loop.simulate_loops` (1 or 3, M, na, C, S), or None if compiled code is not available.

    Args:
        waves: Data of logs and robot.
        trials: Values to simulate.
        often: Steps between samples.
        limits: Smallest inertia [kg m^2], straight part of a bent drive law, turn of a stop's contact in a step [rad], least
            damping of a spring behind a play over the critical one, and change of speeds at which a step of coupled joints has
            converged [rad/s].
        sweeps: Sweeps over the joints of such a step, at most.
        motion: Whether the links' positions and speeds are appended to the positions.
    """
    n, na, s = waves.command.shape
    c, k = trials.inertial.shape[1], len(trials.inertial)
    lanes = next(x for x in _WIDTHS if x >= min(c if waves.coupling is None else na, LANES))
    source = _SOURCE.replace("@NAMES@", ", ".join(NAMES)).replace("@LANES@", str(lanes))
    library = _LIBRARIES.build(source) if is_compiling_allowed() else None
    if library is None:
        return None
    entries = np.empty((len(NAMES), na, c, s))
    for row, name in zip(entries, NAMES, strict=True):
        row[:] = waves.by_log[name][:, None, :] if name in waves.by_log else trials.values[name][:, :, None]
    chosen = 0 if waves.shown is None else len(waves.shown)
    out = np.empty((1 + 2 * motion, na, c, s, chosen or n))
    shown = np.moveaxis(out, -1, 1)
    flags = (waves.encoder_on_motor, waves.measured_on_motor, waves.held)
    own = [np.moveaxis(x, 0, -1) for x in (waves.along, waves.load, waves.inertia, waves.stiffness)]
    make = np.ascontiguousarray if waves.coupling is None else partial(np.array, order="C")  # a copy is filled
    along, load, inertia, stiffness = (make(x) for x in own)
    by = [np.ascontiguousarray(np.moveaxis(x, (0, 2), (-2, -1))) for x in (waves.load_by, waves.inertia_by)]
    near = trials.inertial[:, 0]  # trials about one vector differ from it in few unknowns
    if np.any(near):
        load, inertia = load + by[0] @ near, inertia + by[1] @ near
    coupling, matrices, faults = waves.coupling, np.zeros((2, s, 0, na, na)), []
    every = window = 0
    settle = _SETTLE()
    if coupling is not None:
        out[:] = np.nan
        every, window = coupling.every, coupling.window
        matrices = np.zeros((2, s, -(-n // every) + 1, na, na))
        way, force, own_inertia, growth = (np.moveaxis(x, -1, 0) for x in (along, load, inertia, stiffness))
        rows = LoadRows(way, force, own_inertia, growth, matrices[0], matrices[1], shown[1:, :, :, 0])

        def call(*where: int) -> int:
            try:
                return coupling.settle(rows, *where)
            except Exception as fault:  # noqa: BLE001  (an exception of a callback would be lost)
                faults.append(fault)
                return 1

        settle = _SETTLE(call)
    told, finer = min(COMMANDS.index(waves.told), 2), max(1, -(-waves.profile_steps // often))
    numbers = (n, na, c, s, k, often, *flags, motion, every, matrices.shape[2], window, sweeps, told, finer)
    sizes = np.array([*numbers, waves.apart is not None, chosen], dtype=np.int64)
    passing = np.any(entries[NAMES.index("steps_pass")]) and waves.told == COMMANDS[0]
    steps = waves.steps if passing else np.zeros(waves.command.shape)
    inputs = [waves.dt, waves.start, waves.speed, *(np.moveaxis(x, 0, -1) for x in (waves.command, steps)), along, load]
    inputs += [by[0], inertia, by[1], stiffness]
    inputs += [waves.supply.T, waves.enabled.T, entries, trials.inertial - near[:, None], np.array(limits), *matrices]
    inputs += [np.zeros(0) if x is None else x.T for x in (waves.apart, waves.shown)]
    inputs = [np.ascontiguousarray(x, dtype=float) for x in inputs]
    library.loop_run.restype = ctypes.c_int64
    failed = library.loop_run(*(ctypes.c_void_p(x.ctypes.data) for x in (sizes, *inputs, out)), settle)
    if faults:
        raise faults[0]
    return None if failed else shown
