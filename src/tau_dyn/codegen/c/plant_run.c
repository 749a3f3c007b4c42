#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Rows of numbers, one a sample of the loop unless said otherwise; null pointers where there is no such thing. */
typedef struct {
    int64_t often, substeps, inertia_every, hold; /* samples a record; plant's steps a sample; forces are held from sample to sample */
    double dt, period;                            /* of a plant's step and of the loop [s] */
    const double *theta, *felt;                   /* parameters; temperatures, one row a step of the plant */
    const double *q_ref, *v_ref, *forward, *law, *inertia; /* no q_ref: the forces are given in tau */
    const double *noise, *resolution;             /* of the encoders */
    double *q, *read, *v, *a, *tau;               /* recorded */
    uint8_t *stuck;
} Run;

typedef struct {
    Plant plant;
    double shown[NS], last[NA], before[2 * NA], v_ref[NA], integral[NA], force[NA];
    int reads, drives;
} State;

EXPORT int64_t plant_size(void) { return sizeof(State); }

/* Start at given positions, velocities and passive joints, a controller where it is. */
EXPORT void plant_start_at(State *s, const double *q, const double *v, const double *passive, const double *before,
                           const double *v_ref, const double *integral)
{
    memset(s, 0, sizeof *s);
    for (int i = 0; i < NA; ++i) {
        s->plant.q0[i] = s->plant.start[i] = q[i];
        s->plant.v0[i] = v[i];
    }
    for (int i = 0; i < NP; ++i) s->plant.start[NA + i] = passive[i];
    begin(&s->plant);
    if (!before) return;
    memcpy(s->before, before, sizeof s->before);
    memcpy(s->v_ref, v_ref, sizeof s->v_ref);
    memcpy(s->integral, integral, sizeof s->integral);
}

/* Mass matrices at n positions, followed from a start that plant_start_at set; n, or the first that failed. */
EXPORT int64_t plant_inertia(State *s, const double *theta, const double *q, double *M, int64_t n)
{
    Plant *p = &s->plant;
    const double rest[NA] = {0.0};
    double h[NA];
    memcpy(p->theta, theta, sizeof p->theta);
    for (int64_t k = 0; k < n; ++k) {
        memcpy(p->q, q + k * NA, sizeof p->q);
        if (CLOSED(p) || dynamics(p->q, PASSIVE(p) rest, p->theta, M + k * NA * NA, h)) return k;
    }
    return n;
}

@IF TOOL@
/* Tool positions (n, 3) at n positions, as above. */
EXPORT int64_t plant_tool(State *s, const double *q, double *x, int64_t n)
{
    Plant *p = &s->plant;
    for (int64_t k = 0; k < n; ++k) {
        memcpy(p->q, q + k * NA, sizeof p->q);
        if (CLOSED(p) || tool(p->q, PASSIVE(p) x + 3 * k)) return k;
    }
    return n;
}

@END@
/* What the encoders show of the true positions; noise and rounding come last. */
static int read_encoders(State *s, const Run *r, int64_t k, double *shown)
{
    const double *q = s->plant.q;
@IF ENCODER_MEMORY@
    if (s->reads) {
        double moved_by[NA], next[NS];
        for (int i = 0; i < NA; ++i) moved_by[i] = q[i] - s->last[i];
        if (encoder_memory(s->shown, moved_by, next)) return 1;
        memcpy(s->shown, next, sizeof next);
    }
    s->reads = 1;
    memcpy(s->last, q, sizeof s->last);
@END@
@IF ENCODERS@
    if (encoders(q, @SHOWN@s->plant.theta, shown)) return 1;
@END@
@IF TRUE@
    memcpy(shown, q, NA * sizeof *q);
@END@
    for (int i = 0; i < NA; ++i) {
        if (r->noise) shown[i] += r->noise[k * NA + i];
        if (r->resolution && r->resolution[i] > 0.0) shown[i] = rint(shown[i] / r->resolution[i]) * r->resolution[i];
    }
    return 0;
}

/* The cascade of `controllers.py`: the forces of sample k from what the encoders show. */
static void control(State *s, const Run *r, int64_t k, const double *shown, double *tau)
{
    const double *kp = r->law, *kv = kp + NA, *rate = kv + NA, *share = rate + NA, *unit = share + NA, *limit = unit + NA;
    double push[NA], gain[NA];
    for (int i = 0; i < NA; ++i) {
        const double speed = (shown[i] - s->before[i]) * (0.5 / r->period);
        gain[i] = kv[i] * (kp[i] * (r->q_ref[k * NA + i] - shown[i]) + share[i] * s->v_ref[i] - speed);
        s->before[i] = s->before[NA + i];
        s->before[NA + i] = shown[i];
        s->v_ref[i] = r->v_ref[k * NA + i];
        push[i] = gain[i];
    }
    if (r->inertia) {
        const double *M = r->inertia + k / r->inertia_every * NA * NA;
        for (int i = 0; i < NA; ++i) {
            push[i] = 0.0;
            for (int j = 0; j < NA; ++j) push[i] += M[i * NA + j] * gain[j];
        }
    }
    for (int i = 0; i < NA; ++i) {
        const double wanted = push[i] + s->integral[i] + (r->forward ? r->forward[k * NA + i] : 0.0);
        const double output = wanted < -limit[i] ? -limit[i] : wanted > limit[i] ? limit[i] : wanted;
        if (wanted == output || !(wanted * push[i] > 0.0)) s->integral[i] += rate[i] * push[i] * r->period;
        tau[i] = unit[i] * output;
    }
}

/* One step of the plant; `step` counts them. */
static int move_on(State *s, const Run *r, int64_t step)
{
    Plant *p = &s->plant;
    (void)r, (void)step;
@IF WARM@
    memcpy(p->felt, r->felt + step * NR, sizeof p->felt);
@END@
    const int status = advance(p, r->dt);
    if (status) return status;
@IF MEMORY@
    double moved_by[NA], next[NM];
    for (int i = 0; i < NA; ++i) moved_by[i] = r->dt * p->w[i];
    if (memory(p->memory, moved_by, next)) return 1;
    memcpy(p->memory, next, sizeof next);
@END@
    return 0;
}

/* Run samples from `first` up to `end`, and return the first that failed, or `end`. */
EXPORT int64_t plant_run(State *s, const Run *r, int64_t first, int64_t end)
{
    Plant *p = &s->plant;
    memcpy(p->theta, r->theta, sizeof p->theta);
    for (int64_t k = first; k < end; ++k) {
        const int64_t row = k % r->often ? -1 : k / r->often * NA;
        double shown[NA], tau[NA];
        if (r->q_ref) {
            if (read_encoders(s, r, k, shown)) return k;
            control(s, r, k, shown, tau);
        } else memcpy(tau, r->tau + k * NA, sizeof tau);
        if (row >= 0) for (int i = 0; i < NA; ++i) {
            r->q[row + i] = p->q[i];
            if (r->q_ref) r->tau[row + i] = tau[i];
            if (r->read) r->read[row + i] = shown[i];
        }
        for (int i = 0; i < NA; ++i) p->tau[i] = r->hold && s->drives ? 0.5 * (s->force[i] + tau[i]) : tau[i];
        for (int64_t part = 0; part < r->substeps; ++part) {
            if (move_on(s, r, k * r->substeps + part)) return k;
            if (part == 0 && row >= 0) for (int i = 0; i < NA; ++i) {
                r->v[row + i] = p->w[i] - 0.5 * r->dt * p->a[i];
                r->a[row + i] = p->a[i];
                r->stuck[row + i] = (uint8_t)p->stuck[i];
            }
            memcpy(p->tau, tau, sizeof tau);
        }
        memcpy(s->force, tau, sizeof tau);
        s->drives = 1;
    }
    return end;
}
