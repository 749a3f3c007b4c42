/* Places in the state: velocity of the handle's impedance, last command, filtered tool wrench, normal, force and command that
   give the normal, contact, pull that ended it, samples without load, sums of the stiffness, last force and place, stiffness. */
enum { HELD = 0, SENT = 6, WORK = 12, NORMAL = 18, SMOOTH = 21, ALONG = 24, TOUCHING = 27, RELEASED = 28, QUIET = 29, SUMS = 30,
       LAST = 33, KNOWN = 35, STIFFNESS = 36, SIZE = 37 };

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static double length(const double *a) { return sqrt(dot(a, a)); }
static double most(double a, double b) { return a > b ? a : b; }

static void cross(const double *a, const double *b, double *out)
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void turn(const double *R, const double *x, double *out)
{
    for (int i = 0; i < 3; ++i) out[i] = dot(R + 3 * i, x);
}

static void times(const double *A, const double *x, double *out)
{
    for (int i = 0; i < 6; ++i) {
        out[i] = 0.0;
        for (int j = 0; j < 6; ++j) out[i] += A[6 * i + j] * x[j];
    }
}

/* Wrench at the tool point in world axes, without the weight on the sensor; a sensor is place, axes, weight, centre, offset. */
static void at_tool(const double *sensor, const double *reading, const double *R, double *out)
{
    const double *place = sensor, *axes = sensor + 3, *weight = sensor + 12, *centre = sensor + 15, *offset = sensor + 18;
    double inner[6], own[6], arm[3], more[3];
    for (int i = 0; i < 6; ++i) inner[i] = reading[i] - offset[i];
    turn(axes, inner, own);
    turn(axes, inner + 3, own + 3);
    turn(R, own, out);
    turn(R, own + 3, out + 3);
    turn(axes, centre, own);
    turn(R, own, arm);
    cross(arm, weight, more);
    for (int i = 0; i < 3; ++i) {
        out[i] -= weight[i];
        out[3 + i] -= more[i];
    }
    turn(R, place, arm);
    cross(arm, out, more);
    for (int i = 0; i < 3; ++i) out[3 + i] += more[i];
}

/* Contact with hysteresis: it begins above one load, ends after a time below another, or at once where the hand pulls. */
static void touch(double *s, double load, double pull)
{
    s[QUIET] = load < END_LOAD ? (s[QUIET] < WAIT ? s[QUIET] + 1.0 : s[QUIET]) : 0.0;
    if (s[QUIET] >= WAIT) s[RELEASED] = 0.0;
    if (s[TOUCHING] > 0.0) {
        s[RELEASED] = pull > RELEASE_FORCE;
        s[TOUCHING] = s[RELEASED] == 0.0 && s[QUIET] < WAIT;
    } else {
        s[TOUCHING] = load > 1.0 && s[RELEASED] == 0.0;
    }
}

/* Stiffness by regression of force over place, a few samples long; it falls back slowly. */
static void watch_stiffness(double *s, double force, double place)
{
    s[STIFFNESS] *= FADE;
    if (s[KNOWN] > 0.0) {
        const double df = force - s[LAST], dx = place - s[LAST + 1], keep = 1.0 - 1.0 / SAMPLES;
        double *sum = s + SUMS;
        sum[0] = keep * sum[0] + df * df;
        sum[1] = keep * sum[1] + df * dx;
        sum[2] = keep * sum[2] + dx * dx;
        if (sum[0] > CONTACT_ON * CONTACT_ON && sum[1] > 0.0 && sum[1] * sum[1] > COHERENT * sum[0] * sum[2])
            s[STIFFNESS] = most(s[STIFFNESS], sum[1] / sum[2]);
    }
    s[LAST] = force;
    s[LAST + 1] = place;
    s[KNOWN] = 1.0;
}

/* (8.10) as printed: the direction of the force, or the nominal normal beyond the range. */
static void printed_normal(double *s)
{
    const double *force = s + WORK, size = length(force);
    const int near = size >= WEAK && dot(nominal, force) / size > cos(REACH);
    for (int i = 0; i < 3; ++i) s[NORMAL + i] = near ? force[i] / size : nominal[i];
}

/* The smoothed force without friction gives the normal; beyond the range it stays at the edge. */
static void calm_normal(double *s)
{
    double left[3], across[3];
    for (int i = 0; i < 3; ++i) {
        s[SMOOTH + i] += NORMAL_SMOOTHING * (s[WORK + i] - s[SMOOTH + i]);
        s[ALONG + i] += NORMAL_SMOOTHING * (s[SENT + i] - s[ALONG + i]);
    }
    if (length(s + SMOOTH) < CONTACT_ON) return;
    const double speed = length(s + ALONG), share = speed > SLOW ? dot(s + ALONG, s + SMOOTH) / (speed * speed) : 0.0;
    for (int i = 0; i < 3; ++i) left[i] = s[SMOOTH + i] - share * s[ALONG + i];
    const double straight = dot(nominal, left);
    for (int i = 0; i < 3; ++i) across[i] = left[i] - straight * nominal[i];
    const double size = length(across), tilt = atan2(size, straight), kept = tilt < REACH ? tilt : REACH;
    for (int i = 0; i < 3; ++i)
        s[NORMAL + i] = tilt < 1e-9 ? nominal[i] : cos(kept) * nominal[i] + sin(kept) * across[i] / size;
}

/* Contact state, stiffness and normal from the hand's wrench and the unfiltered and filtered wrenches of the work. */
static void look(double *s, const double *hand, const double *raw, const double *position)
{
    const double *work = s + WORK;
    double load = (TURNS ? fabs(dot(nominal, work)) : length(work)) / CONTACT_ON;
    if (TURNS) load = most(load, length(work + 3) / TORQUE_ON);
    touch(s, load, dot(s + NORMAL, hand));
    const double along = dot(nominal, raw);
    if (along > CONTACT_OFF) watch_stiffness(s, along, -dot(nominal, position));
    else s[SUMS] = s[SUMS + 1] = s[SUMS + 2] = s[KNOWN] = 0.0;
    if (s[TOUCHING] > 0.0) {
        if (CALM) calm_normal(s);
        else printed_normal(s);
        return;
    }
    for (int i = 0; i < 3; ++i) {
        s[NORMAL + i] = nominal[i];
        s[SMOOTH + i] = s[ALONG + i] = 0.0;
    }
}

/* (8.3) within all limits: the hand moves along the surface, the tool's force along the normal. */
static void command(double *s, const double *hand, const double *R, double *out)
{
    const double *n = s + NORMAL, *work = s + WORK;
    double drag[6], pushed[6], by_hand[6], off[6], wish[6], axis[3];
    times(damping, s + SENT, drag);
    for (int i = 0; i < 6; ++i) drag[i] = hand[i] - drag[i];
    times(inverse_mass, drag, pushed);
    for (int i = 0; i < 6; ++i) by_hand[i] = i < 3 ? s[HELD + i] + SAMPLE_TIME * pushed[i] : 0.0;
    const double pressing = s[TOUCHING] > 0.0 ? dot(n, by_hand) : 0.0;
    for (int i = 0; i < 3; ++i) by_hand[i] -= pressing * n[i];
    for (int i = 0; i < 6; ++i) off[i] = work[i] - (i < 3 ? PRESS * n[i] : 0.0);
    times(gain, off, wish);
    const double product = GAIN_ALONG * s[STIFFNESS];
    const double share = WATCH && product > BEARABLE ? BEARABLE / product : 1.0;
    const double along = s[TOUCHING] > 0.0 ? share * dot(n, wish) : 0.0;
    for (int i = 0; i < 3; ++i) {
        wish[i] = along * n[i];
        if (!TURNS || s[TOUCHING] == 0.0) wish[3 + i] = 0.0;
    }
    if (LOCKED) {
        turn(R, locked, axis);
        const double about = dot(axis, wish + 3);
        for (int i = 0; i < 3; ++i) wish[3 + i] -= about * axis[i];
    }
    const double size = length(work);
    if (TOOL_FORCE && size >= FORCE_LIMIT) {
        double away[6] = {work[0] / size, work[1] / size, work[2] / size, 0.0, 0.0, 0.0}, given[6];
        times(gain, away, given);
        const double back = most(0.0, -dot(away, by_hand)) + dot(away, given) * (size - FORCE_LIMIT);
        for (int i = 0; i < 3; ++i) by_hand[i] += back * away[i];
    }
    for (int i = 0; i < 6; ++i) out[i] = by_hand[i] + wish[i];
    const double over = most(1.0, most(length(out) / SPEED_LIMIT, length(out + 3) / TURNING_LIMIT));
    for (int i = 0; i < 6; ++i) {
        out[i] /= over;
        s[HELD + i] = by_hand[i] / over;
        s[SENT + i] = out[i];
    }
}

void @NAME@_start(double state[SIZE])
{
    for (int i = 0; i < SIZE; ++i) state[i] = 0.0;
    for (int i = 0; i < 3; ++i) state[NORMAL + i] = nominal[i];
}

int @NAME@_step(double state[SIZE], const double handle[6], const double tool[6], const double position[3],
                const double rotation[9], double velocity[6])
{
    double s[SIZE], hand[6], raw[6], out[6];
    int wrong = !sound(SIZE, state) || !sound(6, handle) || !sound(6, tool) || !sound(3, position) || !is_rotation(rotation);
    if (!wrong) {
        for (int i = 0; i < SIZE; ++i) s[i] = state[i];
        at_tool(handle_sensor, handle, rotation, hand);
        at_tool(tool_sensor, tool, rotation, raw);
        for (int i = 0; i < 6; ++i) s[WORK + i] += SMOOTHING * (raw[i] - s[WORK + i]);
        if (TOOL_FORCE) look(s, hand, raw, position);
        command(s, hand, rotation, out);
        wrong = !sound(SIZE, s) || !sound(6, out);
    }
    if (wrong) { /* the robot stops, and starts again from rest */
        for (int i = 0; i < 6; ++i) velocity[i] = state[HELD + i] = state[SENT + i] = 0.0;
        return 1;
    }
    for (int i = 0; i < SIZE; ++i) state[i] = s[i];
    for (int i = 0; i < 6; ++i) velocity[i] = out[i];
    return 0;
}
