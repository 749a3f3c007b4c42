#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#ifdef FMI2_FUNCTION_PREFIX /* static linking: each function begins with the model's name */
#define JOINED_(a, b) a##b
#define JOINED(a, b) JOINED_(a, b)
#define FMI(name) JOINED(FMI2_FUNCTION_PREFIX, name)
#else
#define FMI(name) name
#endif

typedef void *Component;
typedef unsigned int Reference;
typedef const char *String;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING } Status;
typedef void (*Logger)(void *, String, Status, String, String, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, Status);
    void *environment;
} Callbacks;

enum { FIRST_Q = NA, FIRST_V = 2 * NA, FIRST_X = 3 * NA, FIRST_T = 3 * NA + NTOOL, FIRST_Q0 = FIRST_T + NTHETA,
       FIRST_V0 = FIRST_Q0 + NA, STEP = FIRST_V0 + NA, REFERENCES };
enum { MADE, SETTING, RUNNING, DONE, BROKEN };

typedef struct {
    Plant plant;
    int phase;
    Callbacks callbacks;
    char name[];
} Instance;

/* The velocity at the sample, extrapolated from half a step back as the dynamics take it. */
static double velocity(const Plant *s, int i)
{
    if (!s->started) return s->w[i];
    return s->stuck[i] ? 0.0 : s->w[i] + 0.5 * s->h * s->a[i];
}

static Status fault(Instance *m, String what)
{
    if (m->callbacks.logger) m->callbacks.logger(m->callbacks.environment, m->name, ERROR, "logStatusError", what);
    return ERROR;
}

static String reason(int status)
{
    return status == 3 ? "the motion is not finite, or beyond @MOST@: a mass is zero, or a force far too large"
                       : "the robot cannot reach this position: its loops do not close";
}

static void defaults(Plant *s)
{
    memset(s, 0, sizeof *s);
    for (int i = 0; i < NTHETA; ++i) s->theta[i] = nominal[i];
    for (int i = 0; i < NA; ++i) s->q0[i] = home_position[i];
    s->step = 1e-3;
    START(s);
    begin(s);
}

EXPORT String FMI(fmi2GetTypesPlatform)(void) { return "default"; }
EXPORT String FMI(fmi2GetVersion)(void) { return "2.0"; }

EXPORT Status FMI(fmi2SetDebugLogging)(Component c, int on, size_t n, const String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return OK;
}

EXPORT Component FMI(fmi2Instantiate)(String name, int kind, String guid, String resources, const Callbacks *callbacks,
                                      int visible, int logging)
{
    (void)resources, (void)visible, (void)logging;
    if (kind != 1 || !name || !guid || strcmp(guid, GUID)) return NULL;
    const size_t length = strlen(name) + 1;
    Instance *m = calloc(1, sizeof(Instance) + length);
    if (!m) return NULL;
    memcpy(m->name, name, length);
    if (callbacks) m->callbacks = *callbacks;
    defaults(&m->plant);
    return m;
}

EXPORT void FMI(fmi2FreeInstance)(Component c) { free(c); }

EXPORT Status FMI(fmi2SetupExperiment)(Component c, int bounded, double tolerance, double start, int stops, double stop)
{
    Instance *m = c;
    (void)bounded, (void)tolerance, (void)stops, (void)stop;
    if (!isfinite(start)) return fault(m, "the start time is not finite");
    m->plant.time = start;
    return OK;
}

EXPORT Status FMI(fmi2EnterInitializationMode)(Component c)
{
    Instance *m = c;
    m->phase = SETTING;
    return OK;
}

EXPORT Status FMI(fmi2ExitInitializationMode)(Component c)
{
    Instance *m = c;
    begin(&m->plant);
    if (CLOSED(&m->plant)) {
        m->phase = BROKEN;
        return fault(m, "the robot cannot reach the initial positions q0");
    }
    m->phase = RUNNING;
    return OK;
}

EXPORT Status FMI(fmi2Terminate)(Component c)
{
    Instance *m = c;
    m->phase = DONE;
    return OK;
}

EXPORT Status FMI(fmi2Reset)(Component c)
{
    Instance *m = c;
    m->phase = MADE;
    defaults(&m->plant);
    return OK;
}

static Status get_one(Instance *m, Reference r, double *value)
{
    Plant *s = &m->plant;
    if (m->phase <= SETTING && r >= FIRST_Q && r < FIRST_T) begin(s);
    if (r < FIRST_Q) *value = s->tau[r];
    else if (r < FIRST_V) *value = s->q[r - FIRST_Q];
    else if (r < FIRST_X) *value = velocity(s, (int)(r - FIRST_V));
    else if (r < FIRST_T) {
        double x[3] = {0.0, 0.0, 0.0};
        const int status = CLOSED(s);
        if (status || TOOL(s, x)) return fault(m, reason(status));
        if (!sound(3, x)) return fault(m, reason(3));
        *value = x[r - FIRST_X];
    }
    else if (r < FIRST_Q0) *value = s->theta[r - FIRST_T];
    else if (r < FIRST_V0) *value = s->q0[r - FIRST_Q0];
    else if (r < STEP) *value = s->v0[r - FIRST_V0];
    else if (r == STEP) *value = s->step;
    else return fault(m, "there is no variable of this value reference");
    return OK;
}

EXPORT Status FMI(fmi2GetReal)(Component c, const Reference r[], size_t n, double value[])
{
    for (size_t k = 0; k < n; ++k) if (get_one(c, r[k], &value[k]) != OK) return ERROR;
    return OK;
}

static Status set_one(Instance *m, Reference r, double value)
{
    Plant *s = &m->plant;
    if (!isfinite(value)) return fault(m, "a value is not finite");
    if ((r < FIRST_Q || (r >= FIRST_Q0 && r < STEP)) && !sound(1, &value)) return fault(m, "a value is beyond @MOST@");
    if (r >= FIRST_Q0 && m->phase > SETTING) return fault(m, "q0, v0 and step are fixed once the simulation runs");
    if (r < FIRST_Q) s->tau[r] = value;
    else if (r < FIRST_T) return fault(m, "outputs cannot be set");
    else if (r < FIRST_Q0) s->theta[r - FIRST_T] = value;
    else if (r < FIRST_V0) s->q0[r - FIRST_Q0] = value;
    else if (r < STEP) s->v0[r - FIRST_V0] = value;
    else if (r == STEP && value > 0.0) s->step = value;
    else return fault(m, "there is no variable of this value reference, or a step is not above zero");
    return OK;
}

EXPORT Status FMI(fmi2SetReal)(Component c, const Reference r[], size_t n, const double value[])
{
    for (size_t k = 0; k < n; ++k) if (set_one(c, r[k], value[k]) != OK) return ERROR;
    return OK;
}

EXPORT Status FMI(fmi2DoStep)(Component c, double time, double size, int keeps)
{
    Instance *m = c;
    (void)time, (void)keeps;
    if (m->phase != RUNNING) return fault(m, "there is no step to make before initialization or after the end");
    if (!(size >= 0.0) || !isfinite(size)) return fault(m, "the communication step is not a length of time");
    const double many = ceil(size / m->plant.step - 1e-9);
    if (many > 1e8) return fault(m, "the communication step is more than 1e8 steps of the plant");
    const Plant before = m->plant;
    const int steps = many < 1.0 ? 1 : (int)many;
    for (int k = 0; k < steps && size > 0.0; ++k) {
        int status = advance(&m->plant, size / steps);
        if (!status && k + 1 == steps) status = CLOSED(&m->plant);
        if (status) {
            m->plant = before;
            return fault(m, reason(status));
        }
    }
    return OK;
}

EXPORT Status FMI(fmi2GetFMUstate)(Component c, void **state)
{
    Instance *m = c;
    Instance *copy = *state ? *state : malloc(sizeof(Instance));
    if (!copy) return fault(m, "there is no memory for a state");
    copy->plant = m->plant;
    copy->phase = m->phase;
    *state = copy;
    return OK;
}

EXPORT Status FMI(fmi2SetFMUstate)(Component c, void *state)
{
    Instance *m = c;
    if (!state) return fault(m, "there is no such state");
    m->plant = ((Instance *)state)->plant;
    m->phase = ((Instance *)state)->phase;
    return OK;
}

EXPORT Status FMI(fmi2FreeFMUstate)(Component c, void **state)
{
    (void)c;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return OK;
}

EXPORT Status FMI(fmi2SerializedFMUstateSize)(Component c, void *state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(Plant) + sizeof(int);
    return OK;
}

EXPORT Status FMI(fmi2SerializeFMUstate)(Component c, void *state, char bytes[], size_t size)
{
    if (size < sizeof(Plant) + sizeof(int)) return fault(c, "a serialized state needs more room");
    memcpy(bytes, &((Instance *)state)->plant, sizeof(Plant));
    memcpy(bytes + sizeof(Plant), &((Instance *)state)->phase, sizeof(int));
    return OK;
}

EXPORT Status FMI(fmi2DeSerializeFMUstate)(Component c, const char bytes[], size_t size, void **state)
{
    if (size != sizeof(Plant) + sizeof(int)) return fault(c, "this is no state of this FMU");
    if (FMI(fmi2GetFMUstate)(c, state) != OK) return ERROR;
    memcpy(&((Instance *)*state)->plant, bytes, sizeof(Plant));
    memcpy(&((Instance *)*state)->phase, bytes + sizeof(Plant), sizeof(int));
    return OK;
}

/* What this FMU has none of. */
#define NONE(name, takes, ...) EXPORT Status FMI(name) takes { __VA_ARGS__; return fault(c, "this FMU has no " #name); }
NONE(fmi2GetDirectionalDerivative, (Component c, const Reference *z, size_t nz, const Reference *r, size_t nr, const double *dr,
     double *dz), (void)z, (void)nz, (void)r, (void)nr, (void)dr, (void)dz)
NONE(fmi2SetRealInputDerivatives, (Component c, const Reference *r, size_t n, const int *order, const double *value),
     (void)r, (void)n, (void)order, (void)value)
NONE(fmi2GetRealOutputDerivatives, (Component c, const Reference *r, size_t n, const int *order, double *value),
     (void)r, (void)n, (void)order, (void)value)
NONE(fmi2GetStatus, (Component c, int kind, Status *value), (void)kind, (void)value)
NONE(fmi2GetIntegerStatus, (Component c, int kind, int *value), (void)kind, (void)value)
NONE(fmi2GetBooleanStatus, (Component c, int kind, int *value), (void)kind, (void)value)
NONE(fmi2GetStringStatus, (Component c, int kind, String *value), (void)kind, (void)value)

EXPORT Status FMI(fmi2CancelStep)(Component c) { return fault(c, "steps are complete when fmi2DoStep returns"); }

EXPORT Status FMI(fmi2GetRealStatus)(Component c, int kind, double *value)
{
    if (kind != 2) return fault(c, "this FMU tells the last successful time and no other status");
    *value = ((Instance *)c)->plant.time;
    return OK;
}

/* All variables are real; asking for none of another type is fine. */
#define TYPE(name, type) EXPORT Status FMI(name)(Component c, const Reference *r, size_t n, type *value) \
    { (void)r, (void)value; return n ? fault(c, "all variables are real") : OK; }
TYPE(fmi2GetInteger, int)
TYPE(fmi2GetBoolean, int)
TYPE(fmi2GetString, String)
TYPE(fmi2SetInteger, const int)
TYPE(fmi2SetBoolean, const int)
TYPE(fmi2SetString, const String)
