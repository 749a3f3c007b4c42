"""An FMU's state as bytes, and the functions of FMI 2.0 that it answers with `none`, in C99.

An instance is one block of memory, so its state is copied, stored and restored as bytes. Reference: FMI for Model Exchange and
Co-Simulation 2.0.4, 2.1.8 and 4.2.
"""

STATES = """\
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
#define TYPE(name, type) EXPORT Status FMI(name)(Component c, const Reference *r, size_t n, type *value) \\
    { (void)r, (void)value; return n ? fault(c, "all variables are real") : OK; }
TYPE(fmi2GetInteger, int)
TYPE(fmi2GetBoolean, int)
TYPE(fmi2GetString, String)
TYPE(fmi2SetInteger, const int)
TYPE(fmi2SetBoolean, const int)
TYPE(fmi2SetString, const String)
"""
