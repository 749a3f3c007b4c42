"""The servo loops of `loop.py` as compiled code: the same equations, trial by trial, a hundred times faster.

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
_LIBRARIES = LibraryCache()
_SETTLE = ctypes.CFUNCTYPE(ctypes.c_int64, *(4 * [ctypes.c_int64]))

_SOURCE = r"""
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
enum {@NAMES@, COUNT};
enum {POSITION, SPEED, OUTPUT};
typedef struct {double position, speed;} goal_t;

static inline double least_of(double a, double b) {return a < b ? a : b;}
static inline double most_of(double a, double b) {return a > b ? a : b;}
static inline double clip(double x, double low, double high) {return least_of(most_of(x, low), high);}

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

/* One joint of one log under one trial: numbers, waves, state, and what holds over a sample and over a step */
typedef struct {
  double p[COUNT], h, part, old_part, *past;
  int64_t behind, here, here_step, there, there_step, length, moved, finer;
  int elastic, profiled;
  const double *cmd, *makes_step, *way, *stiff, *ld, *in, *ldb, *inb, *changes;
  const int64_t *which;
  double *shown;
  goal_t g;
  double q, v, m, w, v_before, integral, next_load, mass, last;
  /* total is h over both inertias, S and open are the inverse steps of the twist's rate, firm and loose inverse mobilities */
  double total, share, a, S, stuck, open, firm, loose, gap;
  double rest0, slope, turn, full, loaded, last_loaded;  /* loaded: the link's inertia while the other joints give way */
  double push, damping, friction, rest, q_next, v_next, m_next, w_next;
} joint_t;

/* What the law and the friction do over a step, and its load at the middle: from the state before it */
static void drive(joint_t *x, int64_t N, int64_t often, int64_t k, int64_t i, int on_motor, int told, double supply,
    double straight) {
  const double *p = x->p;
  double h = x->h, half = 0.5 * h;
  int64_t at = k * often + i, one = at - x->behind;
  int64_t now = one < 0 ? 0 : x->here < N ? x->here : N - 1, then = one < 1 ? 0 : x->there < N ? x->there : N - 1;
  double first = x->cmd[now], before = x->cmd[then];
  if (one >= 0 && ++x->here_step == often) {x->here_step = 0; x->here++;}
  if (one >= 1 && ++x->there_step == often) {x->there_step = 0; x->there++;}
  if (p[command_step] > 0) {
    first = p[command_step] * nearbyint(first / p[command_step]);
    before = p[command_step] * nearbyint(before / p[command_step]);
  }
  double goal = first + x->part * (before - first);
  if (x->profiled && told == POSITION) {
    int passes = x->makes_step[now] > 0 || (x->makes_step[then] > 0 && first == before);
    goal = follow(&x->g, first, before, x->part, p[acceleration_limit], p[speed_limit], h, x->finer, passes && p[steps_pass] > 0);
  }
  int motor = on_motor && x->elastic;
  double seen = motor ? x->m : x->q, seen_speed = motor ? x->w : x->v, turning = x->elastic ? x->w : x->v;
  double middle = x->q + half * x->v, e = goal, u = goal, slow = 0.0, gain = p[integral_gain];
  if (told == POSITION) {
    e = goal - (seen + half * seen_speed);
    if (p[dead_band] > 0) e = (e > 0 ? 1.0 : e < 0 ? -1.0 : 0.0) * most_of(fabs(e) - p[dead_band], 0.0);
    u = p[position_gain] * e - p[derivative_gain] * seen_speed;
  }
  if (told != OUTPUT && p[speed_gain] > 0) {  /* a loop of speed, alone or inside that of position */
    e = clip(told == POSITION ? u : goal, -p[speed_limit], p[speed_limit]) - seen_speed;
    u = p[speed_gain] * e; slow = p[speed_gain]; gain = p[speed_integral_gain];
  }
  if (told != OUTPUT && gain != 0) {  /* to the middle of the step; a speed's error over the last one is known by now */
    if (p[speed_gain] > 0) x->integral -= half * gain * (seen_speed - x->v_before);
    x->v_before = seen_speed;
    u += clip(x->integral + half * gain * e, -p[limit], p[limit]);
    x->integral = clip(x->integral + gain * h * e, -p[limit], p[limit]);
  }
  /* what torque is lost per unit of speed; a loop of speed's part where it acts at once and is not at its limit */
  double loses = p[back_emf] + (told != OUTPUT && !x->past && fabs(u) < p[limit] ? supply * slow : 0.0);
  u = clip(u, -p[limit], p[limit]);
  u = u * (1.0 - p[supply_sag] * fabs(u));
  if (x->past) {
    if (at == 0) for (int64_t n = 0; n < x->length; n++) x->past[n] = u;
    x->past[at % x->length] = u;
    double newer = x->past[(at + 2) % x->length], older = x->past[(at + 1) % x->length];
    u = newer + x->old_part * (older - newer);
  }
  double y = u * supply - p[back_emf] * turning, push, lever;
  if (p[drive_exponent] != 1.0) {
    double grown = x->full * pow(most_of(fabs(y), straight), p[drive_exponent] - 1.0);
    push = grown * y;
    lever = grown * (fabs(y) > straight ? p[drive_exponent] : 1.0) * loses;
  } else {push = x->full * y; lever = x->full * loses;}
  if (y * u < 0) {push *= p[braking]; lever *= p[braking];}
  double late = (double)i + 0.5;
  x->rest = x->rest0 + late * x->slope + x->stiff[k] * (middle - x->way[k] - late * x->turn);
  x->damping = 0.5 * (lever + p[viscous]);
  x->friction = p[coulomb] + p[load_friction] * fabs(push) + p[carried_friction] * fabs(x->rest);
  if (p[stiction] != 0) x->friction += p[stiction] * exp(-fabs(turning) / p[stiction_speed]);
  x->push = push + (x->damping - p[viscous]) * turning;
}

/* The state after a step under a load */
static void turn_joint(joint_t *x, double rest) {
  const double *p = x->p;
  double half = 0.5 * x->h, friction = x->friction, damping = x->damping, v = x->v;
  if (!x->elastic) {
    double wanted = x->firm * v + x->push - rest, after = (wanted - (v > 0 ? friction : -friction)) / (x->firm + damping);
    double path = v + after;
    if (v == 0 || after * v <= 0) {  /* at rest, or comes to rest after a part of the step */
      double moving = v != 0 ? v / (v - after) : 0.0;
      wanted -= (x->firm - damping) * v;
      if (v != 0 && p[stiction] != 0) friction += p[stiction] * (1.0 - exp(-fabs(v) / p[stiction_speed]));
      after = (wanted - clip(wanted, -friction, friction)) / (x->firm / (1.0 - moving) + damping);
      path = moving * v + (1.0 - moving) * after;
    }
    x->q_next = x->q + half * path; x->v_next = after;
    return;
  }
  double twist = x->m - x->q, rate = x->w - v, pull = 0.0, A = 1.0, S_now = x->open, inverse = x->loose, share = x->share;
  if (fabs(twist) >= x->gap) {
    pull = x->stuck * (twist - (twist > 0 ? x->gap : -x->gap)); A = x->a; S_now = x->S; inverse = x->firm;
  }
  double base = A * rate + ((1.0 - share) * rest - pull) * S_now, common = x->w - share * rate - x->total * rest;
  double wanted = (common + share * base) * inverse + x->push;
  double left = wanted - clip(wanted, -friction, friction);
  x->w_next = left / (inverse + damping);
  double motor_force = left - damping * x->w_next - (common + share * base) * inverse;
  x->v_next = x->w_next - base - share * motor_force * S_now;
  x->m_next = x->m + half * (x->w + x->w_next); x->q_next = x->q + half * (v + x->v_next);
}

static void take_inertia(joint_t *x, double least, double contact, double teeth) {
  const double *p = x->p;
  double h = x->h;
  if (x->mass == x->last && x->loaded == x->last_loaded) return;
  x->last = x->mass; x->last_loaded = x->loaded;
  if (!x->elastic) {x->firm = most_of(x->mass + p[armature], least) / h; return;}
  double motor = most_of(p[armature], least), link = most_of(x->mass, least), mu, share;
  x->total = h / (motor + link); share = x->share = link / (motor + link); mu = motor * share;
  x->stuck = p[joint_compliance] > 0 ? 1.0 / p[joint_compliance] : mu * (contact / h) * (contact / h);
  /* the coupling itself takes `more` off the twist's inertia over the step */
  double gives = p[joint_compliance] > 0 ? clip(x->loaded, least, link) : link;
  double mine = motor * gives / (motor + gives), more = (mu - mine) / h;
  double critical = 2.0 * sqrt(x->stuck * mine), slack = x->gap > 0 ? teeth * critical : 0.0;
  spring(x->stuck, p[joint_compliance] > 0 ? most_of(p[joint_damping], slack) : critical, mine, h, &x->a, &x->S);
  x->a = (x->a * x->S + more) / (x->S + more); x->S += more;
  x->S = 1.0 / x->S; x->open = h / mu;
  x->firm = 1.0 / (x->total + share * share * x->S); x->loose = 1.0 / (x->total + share * share * x->open);
}

/* Inertias of links behind springs while the other joints give way: the inverse of the inverse mass matrix's diagonal, with the
   drives of rigid joints on their links */
static void take_loaded_inertias(joint_t *all, int64_t J, const double *M, double *y, double *A) {
  for (int64_t n = 0; n < J; n++) for (int64_t j = 0; j <= n; j++) {
    double sum = M[n * J + j] + (n == j && !all[n].elastic ? all[n].p[armature] : 0.0), own = sum;
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
    all[n].loaded = 1.0 / square;
  }
}

/* What a trial's inertial unknowns add to a row: only those that differ from the waves' own */
static double combine(const double *by, const double *changes, const int64_t *which, int64_t K) {
  double a = 0.0, b = 0.0;
  int64_t i = 0;
  for (; i + 2 <= K; i += 2) {a += by[which[i]] * changes[i]; b += by[which[i + 1]] * changes[i + 1];}
  if (i < K) a += by[which[i]] * changes[i];
  return a + b;
}

static void show(joint_t *x, int64_t k, int64_t plane, int on_motor, int with_speeds) {
  x->shown[k] = on_motor && x->elastic ? x->m : x->q;
  if (with_speeds) {x->shown[k + plane] = x->q; x->shown[k + 2 * plane] = x->v;}
}

/* Speeds' changes d of joints that slide on while the others rest: (M / h + own) d = force, by Cholesky */
static void guess_changes(const joint_t *all, int64_t J, const double *M, double *d, double *A) {
  double h = all->h;
  for (int64_t n = 0; n < J; n++) {
    const joint_t *x = all + n;
    if (x->elastic) continue;
    double *row = A + n * J, own = x->firm + x->damping;
    d[n] = x->v == 0 ? 0.0 : x->push - x->rest - (x->v > 0 ? x->friction : -x->friction) - x->damping * x->v;
    for (int64_t j = 0; j <= n; j++) row[j] = x->v == 0 || all[j].v == 0 || all[j].elastic ? 0.0 : M[n * J + j] / h;
    row[n] = own;
    for (int64_t j = 0; j <= n; j++) {
      if (all[j].elastic) continue;
      double sum = row[j];
      for (int64_t i = 0; i < j; i++) if (!all[i].elastic) sum -= row[i] * A[j * J + i];
      if (j < n) row[j] = sum / A[j * J + j];
      else row[n] = sqrt(most_of(sum, 1e-12 * own));
    }
    for (int64_t j = 0; j < n; j++) if (!all[j].elastic) d[n] -= row[j] * d[j];
    d[n] /= row[n];
  }
  for (int64_t n = J - 1; n >= 0; n--) if (!all[n].elastic) {
    for (int64_t j = n + 1; j < J; j++) if (!all[j].elastic) d[n] -= A[j * J + n] * d[j];
    d[n] /= A[n * J + n];
  }
}

/* A step of all joints by projected Gauss-Seidel: each one's load grows as the others' speeds change */
static void turn_together(joint_t *all, int64_t J, double *M, int64_t k, int64_t i, int64_t sweeps, double settled) {
  double h = all->h, late = (double)i + 0.5, *G = M + J * J, *d = G + J * J;
  for (int64_t n = 0; n < J; n++) {
    double apart = all[n].q + 0.5 * h * all[n].v - all[n].way[k] - late * all[n].turn;
    for (int64_t j = 0; j < J; j++) if (j != n) all[j].rest += G[j * J + n] * apart;
  }
  for (int64_t n = 0; n < J; n++) d[n] = all[n].v_next;  /* a first guess for springs: they change as in the step before */
  guess_changes(all, J, M, d, d + J);
  for (int64_t turns = 0; turns < sweeps; turns++) {
    double most = 0.0;
    for (int64_t n = 0; n < J; n++) {
      double pull = -M[n * J + n] * d[n];
      for (int64_t j = 0; j < J; j++) pull += M[n * J + j] * d[j];
      turn_joint(all + n, all[n].rest + pull / h);
      double change = all[n].v_next - all[n].v;
      most = most_of(most, fabs(change - d[n]));
      d[n] = change;
    }
    if (!(most > settled)) return;
  }
}

/* Trials of a joint that are stepped in turn: a step waits for its own divisions, so others fill the time */
enum {LANES = 8};

__attribute__((visibility("default")))
int64_t loop_run(const int64_t *size, const double *dt, const double *start, const double *speed, const double *command,
    const double *makes_step, const double *along, const double *load,
    const double *load_by, const double *inertia, const double *inertia_by,
    const double *stiffness, const double *supply, const double *enabled, const double *entries, const double *inertial,
    const double *limits, const double *masses, const double *slopes, double *out, settle_t settle) {
  int64_t N = size[0], J = size[1], C = size[2], L = size[3], K = size[4], often = size[5], every = size[10], R = size[11];
  int on_motor = (int)size[6], shown_on_motor = (int)size[7], held_load = (int)size[8], with_speeds = (int)size[9];
  int64_t together = every ? J : LANES, window = size[12], sweeps = size[13], failed = 0;  /* together are stepped in turn */
  int told = (int)size[14];
  int64_t plane = J * C * L * N;
  double least = limits[0], straight = limits[1], contact = limits[2], teeth = limits[3], settled = limits[4];
  joint_t *all = malloc(2 * (size_t)together * sizeof(joint_t)), *kept = all + together;
  int64_t trials = every ? 1 : LANES;
  double *M = malloc((size_t)(3 * J * J + J + trials * K) * sizeof(double)), *G = M + J * J;  /* and room for a step */
  double *changes = M + 3 * J * J + J;
  int64_t *which = malloc((size_t)(trials * K + 1) * sizeof(int64_t)), moved[LANES] = {0};
  if (!all || !M || !which) {free(all); free(M); free(which); return 1;}
  for (int64_t s = 0; s < L && !failed; s++) for (int64_t j0 = 0; j0 < J; j0 += every ? J : 1)
  for (int64_t c0 = 0; c0 < C; c0 += trials) {
    double h = dt[s] / (double)often;
    const double *sup = supply + s * N, *en = enabled + s * N;
    int64_t lanes = trials < C - c0 ? trials : C - c0;
    together = every ? J : lanes;
    for (int64_t n = 0; n < lanes; n++) {
      moved[n] = 0;
      for (int64_t i = 0; i < K; i++) if (inertial[i * C + c0 + n] != 0.0) {
        changes[n * K + moved[n]] = inertial[i * C + c0 + n]; which[n * K + moved[n]++] = i;
      }
    }
    for (int64_t n = 0; n < together; n++) {
      joint_t *x = all + n;
      int64_t j = every ? n : j0, lane = every ? 0 : n, c = c0 + lane, row = (j * L + s) * N;
      x->changes = changes + lane * K; x->which = which + lane * K; x->moved = moved[lane];
      double *p = x->p;
      for (int i = 0; i < COUNT; i++) p[i] = entries[((i * J + j) * C + c) * L + s];
      x->h = h; x->finer = size[15]; x->cmd = command + row; x->makes_step = makes_step + row;
      x->way = along + row; x->stiff = stiffness + row;
      x->ld = load + row; x->in = inertia + row; x->ldb = load_by + row * K; x->inb = inertia_by + row * K;
      x->shown = out + ((j * C + c) * L + s) * N;
      double late = p[command_delay] / h, whole = floor(late);
      x->part = late - whole; x->behind = (int64_t)whole;
      x->here = x->here_step = x->there = x->there_step = 0;
      if (x->behind < 0) {
        x->here = -x->behind / often; x->here_step = -x->behind % often;
        x->there = (-x->behind - 1) / often; x->there_step = (-x->behind - 1) % often;
      }
      double old = p[torque_delay] / h, old_whole = floor(old);
      x->old_part = old - old_whole; x->length = (int64_t)old_whole + 2;
      x->past = p[torque_delay] > 0 ? malloc(2 * (size_t)x->length * sizeof(double)) : NULL;
      if (p[torque_delay] > 0 && !x->past) failed = 1;
      x->elastic = p[joint_compliance] > 0 || p[backlash] > 0;
      x->profiled = isfinite(p[speed_limit]) || isfinite(p[acceleration_limit]);
      x->gap = 0.5 * p[backlash]; x->integral = 0.0; x->last = -1.0;
      x->q = x->m = start[j * L + s]; x->v = x->w = x->v_before = speed[j * L + s];
      x->v_next = 0.0;  /* between steps, what the last one changed */
      x->g.position = x->cmd[0]; x->g.speed = 0.0;
      if (p[command_step] > 0) x->g.position = p[command_step] * nearbyint(x->cmd[0] / p[command_step]);
      x->next_load = x->ld[0];
      if (x->moved) x->next_load += combine(x->ldb, x->changes, x->which, x->moved);
      if (x->elastic) {
        double rest0 = x->next_load + p[offset];
        double twist = p[joint_compliance] * rest0 + (rest0 > 0 ? x->gap : rest0 < 0 ? -x->gap : 0.0);
        if (shown_on_motor) x->q -= twist; else x->m += twist;
      }
    }
    int64_t step = every ? window : N;
    for (int64_t begin = 0; begin < N && !failed; begin += step) {
      int64_t stop = begin + step < N - 1 ? begin + step : N - 1, turn = 0;
      for (int64_t n = 0; n < together; n++) {
        joint_t *x = all + n;
        kept[n] = *x;
        if (x->past) memcpy(x->past + x->length, x->past, (size_t)x->length * sizeof(double));
        show(x, begin, plane, shown_on_motor, with_speeds);
      }
      if (every && begin < stop && settle(s, begin, stop, turn)) break;
      while (begin < stop) {
        for (int64_t k = begin; k < stop; k++) {
          for (int64_t n = 0; n < together; n++) {
            joint_t *x = all + n;
            double now = held_load ? x->ld[k] : x->next_load;
            x->mass = x->in[k]; x->next_load = x->ld[k + 1];
            if (x->moved) {
              x->mass += combine(x->inb + k * K, x->changes, x->which, x->moved);
              x->next_load += combine(x->ldb + (k + 1) * K, x->changes, x->which, x->moved);
            }
            x->rest0 = now + x->p[offset];
            x->slope = held_load ? 0.0 : (x->next_load - now) / (double)often;
            x->turn = (x->way[k + 1] - x->way[k]) / (double)often;
            x->full = x->p[force_per_unit] * en[k];
            x->loaded = x->mass;
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
          for (int64_t n = 0; n < together; n++) take_inertia(all + n, least, contact, teeth);
          for (int64_t i = 0; i < often; i++) {
            for (int64_t n = 0; n < together; n++) drive(all + n, N, often, k, i, on_motor, told, sup[k], straight);
            if (every) turn_together(all, J, M, k, i, sweeps, settled);
            else for (int64_t n = 0; n < together; n++) turn_joint(all + n, all[n].rest);
            for (int64_t n = 0; n < together; n++) {
              joint_t *x = all + n;
              double gained = x->v_next - x->v;
              x->q = x->q_next; x->v = x->v_next;
              if (x->elastic) {x->m = x->m_next; x->w = x->w_next;}
              x->v_next = gained;
            }
          }
          for (int64_t n = 0; n < together; n++) show(all + n, k + 1, plane, shown_on_motor, with_speeds);
        }
        if (!every || settle(s, begin, stop, ++turn)) break;
        for (int64_t n = 0; n < together; n++) {
          joint_t *x = all + n;
          *x = kept[n];
          if (x->past) memcpy(x->past, x->past + x->length, (size_t)x->length * sizeof(double));
        }
      }
    }
    for (int64_t n = 0; n < together; n++) free(all[n].past);
  }
  free(all); free(M); free(which);
  return failed;
}
"""


def run_compiled(
    waves: Waves, trials: Trials, often: int, limits: tuple[float, ...], sweeps: int, motion: bool
) -> np.ndarray | None:
    """Return the result of `loop.simulate_loops` (1 or 3, N, na, C, S), or None if compiled code is not available.

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
    source = _SOURCE.replace("@NAMES@", ", ".join(NAMES))
    library = _LIBRARIES.build(source) if is_compiling_allowed() else None
    if library is None:
        return None
    n, na, s = waves.command.shape
    c, k = trials.inertial.shape[1], len(trials.inertial)
    entries = np.empty((len(NAMES), na, c, s))
    for row, name in zip(entries, NAMES, strict=True):
        row[:] = waves.by_log[name][:, None, :] if name in waves.by_log else trials.values[name][:, :, None]
    out = np.empty((1 + 2 * motion, na, c, s, n))
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
    sizes = np.array(
        [
            n,
            na,
            c,
            s,
            k,
            often,
            *flags,
            motion,
            every,
            matrices.shape[2],
            window,
            sweeps,
            min(COMMANDS.index(waves.told), 2),
            max(1, -(-waves.profile_steps // often)),
        ],
        dtype=np.int64,
    )
    passing = np.any(entries[NAMES.index("steps_pass")]) and waves.told == COMMANDS[0]
    steps = waves.steps if passing else np.zeros(waves.command.shape)
    inputs = [waves.dt, waves.start, waves.speed, *(np.moveaxis(x, 0, -1) for x in (waves.command, steps)), along, load]
    inputs += [by[0], inertia, by[1], stiffness]
    inputs += [waves.supply.T, waves.enabled.T, entries, trials.inertial - near[:, None], np.array(limits), *matrices]
    inputs = [np.ascontiguousarray(x, dtype=float) for x in inputs]
    library.loop_run.restype = ctypes.c_int64
    failed = library.loop_run(*(ctypes.c_void_p(x.ctypes.data) for x in (sizes, *inputs, out)), settle)
    if faults:
        raise faults[0]
    return None if failed else shown
