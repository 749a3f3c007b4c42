"""The servo loops of `loop.py` as compiled code: the same equations, trial by trial, a hundred times faster.

The source is C99, built once and kept (`codegen/compiler.py`). Where there is no compiler, or `TAU_DYN_COMPILE=0` says so,
`loop.py` steps all trials at once in numpy; both agree to rounding.
"""

from __future__ import annotations

import ctypes

import numpy as np

from tau_dyn.codegen import LibraryCache, is_compiling_allowed
from tau_dyn.servo.waves import Trials, Waves
from tau_dyn.simulate import SERVO_ENTRIES

NAMES = (*SERVO_ENTRIES, "armature", "coulomb", "viscous", "offset")
"""Numbers of a joint in the order in which the kernel takes them."""
_LIBRARIES = LibraryCache()

_SOURCE = r"""
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
enum {@NAMES@, COUNT};
typedef struct {double position, speed;} goal_t;

static inline double least_of(double a, double b) {return a < b ? a : b;}
static inline double most_of(double a, double b) {return a > b ? a : b;}
static inline double clip(double x, double low, double high) {return least_of(most_of(x, low), high);}

static double follow(goal_t *g, double target, double limit, double speed, double h) {
  double distance = target - g->position, most = limit * h;
  double braking = sqrt(most_of(2.0 * limit * fabs(distance), 0.0));
  double wanted = least_of(least_of(braking, speed), fabs(distance) / h);
  wanted = distance > 0 ? wanted : distance < 0 ? -wanted : 0.0;
  g->speed += clip(wanted - g->speed, -most, most);
  g->position += h * g->speed;
  return g->position;
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

__attribute__((visibility("default")))
int64_t loop_run(const int64_t *size, const double *dt, const double *start, const double *speed, const double *command,
    const double *along, const double *load, const double *load_by, const double *inertia, const double *inertia_by,
    const double *stiffness, const double *supply, const double *enabled, const double *entries, const double *inertial,
    const double *limits, double *out) {
  int64_t N = size[0], J = size[1], C = size[2], L = size[3], K = size[4], often = size[5];
  int on_motor = (int)size[6], shown_on_motor = (int)size[7], held_load = (int)size[8], with_speeds = (int)size[9];
  double least = limits[0], straight = limits[1], contact = limits[2];
  for (int64_t s = 0; s < L; s++) for (int64_t j = 0; j < J; j++) for (int64_t c = 0; c < C; c++) {
    double p[COUNT], h = dt[s] / (double)often;
    for (int i = 0; i < COUNT; i++) p[i] = entries[((i * J + j) * C + c) * L + s];
    const double *cmd = command + (j * L + s) * N, *way = along + (j * L + s) * N, *stiff = stiffness + (j * L + s) * N;
    const double *ld = load + (j * L + s) * N, *in = inertia + (j * L + s) * N;
    const double *ldb = load_by + (j * L + s) * N * K, *inb = inertia_by + (j * L + s) * N * K;
    double *shown = out + ((j * C + c) * L + s) * N;
    const double *sup = supply + s * N, *en = enabled + s * N;
    int moved = 0;
    for (int64_t i = 0; i < K; i++) moved = moved || inertial[i * C + c] != 0.0;
    double late = p[command_delay] / h, whole = floor(late), part = late - whole;
    int64_t behind = (int64_t)whole, here = 0, here_step = 0, there = 0, there_step = 0;
    if (behind < 0) {
      here = -behind / often; here_step = -behind % often;
      there = (-behind - 1) / often; there_step = (-behind - 1) % often;
    }
    double old = p[torque_delay] / h, old_whole = floor(old), old_part = old - old_whole;
    int64_t length = (int64_t)old_whole + 2;
    int waits = p[torque_delay] > 0;
    double *past = waits ? malloc((size_t)length * sizeof(double)) : NULL;
    if (waits && !past) return 1;
    int elastic = p[joint_compliance] > 0 || p[backlash] > 0;
    int profiled = isfinite(p[speed_limit]) || isfinite(p[acceleration_limit]);
    double half = 0.5 * h, gap = 0.5 * p[backlash], integral = 0.0;
    double q = start[j * L + s], v = speed[j * L + s], m = q, w = v, next_load = 0.0;
    goal_t g = {cmd[0], 0.0};
    if (p[command_step] > 0) g.position = p[command_step] * nearbyint(cmd[0] / p[command_step]);
    /* total is h over both inertias, S and open are the inverse steps of the twist's rate, firm and loose inverse mobilities */
    double total = 0, mu = 0, share = 0, a = 0, S = 0, stuck = 0, open = 0, firm = 0, loose = 0, last = -1.0;
    for (int64_t k = 0; k < N; k++) {
      double now, mass = in[k];
      if (k == 0) {
        next_load = ld[0];
        if (moved) for (int64_t i = 0; i < K; i++) next_load += ldb[i] * inertial[i * C + c];
      }
      now = next_load;
      if (moved) for (int64_t i = 0; i < K; i++) mass += inb[k * K + i] * inertial[i * C + c];
      double rest0 = now + p[offset];
      if (k == 0 && elastic) {
        double twist = p[joint_compliance] * rest0 + (rest0 > 0 ? gap : rest0 < 0 ? -gap : 0.0);
        if (shown_on_motor) q -= twist; else m += twist;
      }
      shown[k] = shown_on_motor && elastic ? m : q;
      if (with_speeds) shown[k + J * C * L * N] = shown_on_motor && elastic ? w : v;
      if (k == N - 1) break;
      next_load = ld[k + 1];
      if (moved) for (int64_t i = 0; i < K; i++) next_load += ldb[(k + 1) * K + i] * inertial[i * C + c];
      if (mass == last) {
      } else if (elastic) {
        double motor = most_of(p[armature], least), link = most_of(mass, least);
        total = h / (motor + link); share = link / (motor + link); mu = motor * share;
        stuck = p[joint_compliance] > 0 ? 1.0 / p[joint_compliance] : mu * (contact / h) * (contact / h);
        spring(stuck, p[joint_compliance] > 0 ? p[joint_damping] : 2.0 * mu * contact / h, mu, h, &a, &S);
        S = 1.0 / S; open = h / mu;
        firm = 1.0 / (total + share * share * S); loose = 1.0 / (total + share * share * open);
      } else firm = most_of(mass + p[armature], least) / h;
      last = mass;
      double slope = held_load ? 0.0 : (next_load - now) / (double)often, turn = (way[k + 1] - way[k]) / (double)often;
      double full = p[force_per_unit] * en[k];
      for (int64_t i = 0; i < often; i++) {
        int64_t at = k * often + i, one = at - behind;
        double first = cmd[one < 0 ? 0 : here < N ? here : N - 1];
        double before = cmd[one < 1 ? 0 : there < N ? there : N - 1];
        if (one >= 0 && ++here_step == often) {here_step = 0; here++;}
        if (one >= 1 && ++there_step == often) {there_step = 0; there++;}
        if (p[command_step] > 0) {
          first = p[command_step] * nearbyint(first / p[command_step]);
          before = p[command_step] * nearbyint(before / p[command_step]);
        }
        double goal = first + part * (before - first);
        if (profiled) goal = follow(&g, goal, p[acceleration_limit], p[speed_limit], h);
        double seen = on_motor && elastic ? m : q, seen_speed = on_motor && elastic ? w : v, drive = elastic ? w : v;
        double middle = q + half * v, e = goal - (seen + half * seen_speed);
        if (p[dead_band] > 0) e = (e > 0 ? 1.0 : e < 0 ? -1.0 : 0.0) * most_of(fabs(e) - p[dead_band], 0.0);
        double u = p[position_gain] * e - p[derivative_gain] * seen_speed;
        if (p[integral_gain] != 0) {
          integral = clip(integral + p[integral_gain] * h * e, -p[limit], p[limit]);
          u += integral;
        }
        u = clip(u, -p[limit], p[limit]);
        u = u * (1.0 - p[supply_sag] * fabs(u));
        if (waits) {
          if (at == 0) for (int64_t n = 0; n < length; n++) past[n] = u;
          past[at % length] = u;
          double newer = past[(at + length - (length - 2)) % length], older = past[(at + 1) % length];
          u = newer + old_part * (older - newer);
        }
        double x = u * sup[k] - p[back_emf] * drive, push, lever;
        if (p[drive_exponent] != 1.0) {
          double grown = full * pow(most_of(fabs(x), straight), p[drive_exponent] - 1.0);
          push = grown * x;
          lever = grown * (fabs(x) > straight ? p[drive_exponent] : 1.0) * p[back_emf];
        } else {push = full * x; lever = full * p[back_emf];}
        if (x * u < 0) {push *= p[braking]; lever *= p[braking];}
        double rest = rest0 + ((double)i + 0.5) * slope + stiff[k] * (middle - way[k] - ((double)i + 0.5) * turn);
        double damping = 0.5 * (lever + p[viscous]);
        double friction = p[coulomb] + p[load_friction] * fabs(push);
        if (p[stiction] != 0) friction += p[stiction] * exp(-fabs(drive) / p[stiction_speed]);
        push += (damping - p[viscous]) * drive;
        if (!elastic) {
          double wanted = firm * v + push - rest, after = (wanted - (v > 0 ? friction : -friction)) / (firm + damping);
          if (v != 0 && after * v > 0) q += half * (v + after);
          else {  /* at rest, or comes to rest after a part of the step */
            double moving = v != 0 ? v / (v - after) : 0.0;
            wanted -= (firm - damping) * v;
            if (v != 0 && p[stiction] != 0) friction += p[stiction] * (1.0 - exp(-fabs(v) / p[stiction_speed]));
            after = (wanted - clip(wanted, -friction, friction)) / (firm / (1.0 - moving) + damping);
            q += half * (moving * v + (1.0 - moving) * after);
          }
          v = after;
          continue;
        }
        double twist = m - q, rate = w - v, pull = 0.0, A = 1.0, S_now = open, inverse = loose;
        if (fabs(twist) >= gap) {
          pull = stuck * (twist - (twist > 0 ? gap : -gap)); A = a; S_now = S; inverse = firm;
        }
        double base = A * rate + ((1.0 - share) * rest - pull) * S_now, common = w - share * rate - total * rest;
        double wanted = (common + share * base) * inverse + push;
        double left = wanted - clip(wanted, -friction, friction);
        double w_next = left / (inverse + damping);
        double motor_force = left - damping * w_next - (common + share * base) * inverse;
        double rate_next = base + share * motor_force * S_now;
        double v_next = w_next - rate_next;
        m += half * (w + w_next); q += half * (v + v_next);
        w = w_next; v = v_next;
      }
    }
    free(past);
  }
  return 0;
}
"""


def run_compiled(
    waves: Waves, trials: Trials, often: int, limits: tuple[float, float, float], speeds: bool
) -> np.ndarray | None:
    """Return what `loop.simulate_loops` steps (1 or 2, N, na, C, S), or None where compiled code is not possible here.

    Args:
        waves: What logs and robot give.
        trials: Values to simulate.
        often: Steps between samples.
        limits: Smallest inertia [kg m^2], straight part of a bent drive law, and turn of a stop's contact in a step [rad].
        speeds: Whether speeds follow the positions.
    """
    library = _LIBRARIES.build(_SOURCE.replace("@NAMES@", ", ".join(NAMES))) if is_compiling_allowed() else None
    if library is None:
        return None
    n, na, s = waves.command.shape
    c, k = trials.inertial.shape[1], len(trials.inertial)
    entries = np.empty((len(NAMES), na, c, s))
    for row, name in zip(entries, NAMES, strict=True):
        row[:] = waves.by_log[name][:, None, :] if name in waves.by_log else trials.values[name][:, :, None]
    flags = (waves.encoder_on_motor, waves.measured_on_motor, waves.held)
    sizes = np.array([n, na, c, s, k, often, *flags, speeds], dtype=np.int64)
    rows = [np.moveaxis(x, 0, -1) for x in (waves.command, waves.along, waves.load)]
    rows += [np.moveaxis(waves.load_by, (0, 2), (-2, -1)), np.moveaxis(waves.inertia, 0, -1)]
    rows += [np.moveaxis(waves.inertia_by, (0, 2), (-2, -1)), np.moveaxis(waves.stiffness, 0, -1)]
    rows += [waves.supply.T, waves.enabled.T, entries, trials.inertial, np.array(limits)]
    inputs = [np.ascontiguousarray(x, dtype=float) for x in (waves.dt, waves.start, waves.speed, *rows)]
    out = np.empty((1 + speeds, na, c, s, n))
    library.loop_run.restype = ctypes.c_int64
    failed = library.loop_run(*(ctypes.c_void_p(x.ctypes.data) for x in (sizes, *inputs, out)))
    return None if failed else np.ascontiguousarray(np.moveaxis(out, -1, 1))
