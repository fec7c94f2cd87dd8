/* Generated variables of a station; eap/pd/links.py is the reference. */

#include "cyclic.h"

#include <math.h>

enum { COUNTER, RAMP, SINE, RANDOM };
/* Integers up to here are exact as floating-point numbers. */
#define EXACT (1LL << 53)
/* Numbers that are rounded to integers are smaller. */
#define LARGEST ((double)(1LL << 62))

/* One variable, as eap/pd/compiledsources.py packs it. */
typedef struct {
    int64_t kind, target, size, is_float;
    int64_t step, positions;             /* of a counter; a step through so many positions */
    double base, factor, period;         /* ramp: base + factor * part of the period; sine alike */
} Step;

typedef struct {
    PyObject_HEAD
    PyObject *memory, *fallback, *sequences;
    int64_t memory_needed;
    Py_ssize_t count;
    Step *steps;
} SourceSteps;

static void steps_dealloc(SourceSteps *self) {
    Py_XDECREF(self->memory);
    Py_XDECREF(self->fallback);
    Py_XDECREF(self->sequences);
    PyMem_Free(self->steps);
    free_object((PyObject *)self);
}

static int steps_check(SourceSteps *self) {
    for (Py_ssize_t n = 0; n < self->count; n++) {
        const Step *step = &self->steps[n];
        PyObject *sequence = PyTuple_GetItem(self->sequences, n);
        if (sequence == NULL || need(&self->memory_needed, step->target, step->size))
            return -1;
        int is_number = step->size == 1 || step->size == 2 || step->size == 4 || step->size == 8;
        if (step->kind < COUNTER || step->kind > RANDOM
            || (step->kind == RANDOM
                    ? step->positions < 1 || step->positions > MAX_INDEX || step->step < 0
                          || step->step > MAX_INDEX || !PyBytes_Check(sequence)
                          || PyBytes_Size(sequence) < step->positions + step->size
                    : !is_number || (step->is_float && step->size < 4))
            || !(fabs(step->base) + fabs(step->factor) < (step->is_float ? INFINITY : LARGEST))
            || ((step->kind == RAMP || step->kind == SINE) && !(step->period >= 1)))
            return refuse("a source of a variable is out of range");
    }
    return 0;
}

/* SourceSteps(steps, sequences, memory, fallback): of a sequence of each step only those of random
   bytes are used; *fallback* computes all of it for times that are not exact.  */
static PyObject *steps_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    const char *octets;
    Py_ssize_t size;
    PyObject *sequences, *memory, *fallback;
    if (!PyArg_ParseTuple(args, "y#O!OO", &octets, &size, &PyTuple_Type, &sequences, &memory,
                          &fallback))
        return NULL;
    SourceSteps *self = (SourceSteps *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    self->sequences = Py_NewRef(sequences);
    self->memory = Py_NewRef(memory);
    self->fallback = Py_NewRef(fallback);
    self->count = size / (Py_ssize_t)sizeof(Step);
    if (size % (Py_ssize_t)sizeof(Step) || PyTuple_Size(sequences) != self->count)
        refuse("steps are cut off");
    else if ((self->steps = PyMem_Malloc((size_t)size + 1)) == NULL)
        PyErr_NoMemory();
    else {
        memcpy(self->steps, octets, (size_t)size);
        if (!steps_check(self))
            return (PyObject *)self;
    }
    Py_DECREF(self);
    return NULL;
}

static void put_integer(char *place, int64_t size, int64_t value) {
    memcpy(place, &value, (size_t)size);  /* little-endian: the module is not used elsewhere */
}

static void put_float(char *place, int64_t size, double value) {
    float narrow = (float)value;
    if (size == 4)
        memcpy(place, &narrow, sizeof narrow);
    else
        memcpy(place, &value, sizeof value);
}

/* Compute one variable; return whether that was possible. */
static int compute(const Step *step, PyObject *sequence, int64_t tick, char *place) {
    if (step->kind == RANDOM) {
        /* The product of a position and a step cannot overflow. */
        int64_t at = tick % step->positions * step->step % step->positions;
        memcpy(place, PyBytes_AsString(sequence) + at, (size_t)step->size);
        return 1;
    }
    double value;
    if (step->kind == COUNTER) {
        int64_t count;
        if (!step->is_float) {
            put_integer(place, step->size, (int64_t)((uint64_t)tick * (uint64_t)step->step));
            return 1;
        }
        if (__builtin_mul_overflow(tick, step->step, &count))
            return 0;
        value = (double)count;
    } else {
        double part = fmod((double)tick, step->period);
        value = step->kind == RAMP ? step->base + step->factor * part / step->period
                                   : step->base + step->factor * sin(2 * M_PI / step->period * part);
    }
    if (step->is_float)
        put_float(place, step->size, value);
    else
        put_integer(place, step->size, (int64_t)rint(value));
    return 1;
}

/* run(tick) */
static PyObject *steps_run(SourceSteps *self, PyObject *tick_object) {
    Py_buffer memory;
    long long tick = PyLong_AsLongLong(tick_object);
    int is_done = tick >= 0 && tick <= EXACT;
    if (tick == -1 && PyErr_Occurred())
        PyErr_Clear();
    if (is_done) {
        if (PyObject_GetBuffer(self->memory, &memory, PyBUF_CONTIG))
            return NULL;
        is_done = memory.len >= self->memory_needed;
        for (Py_ssize_t n = 0; is_done && n < self->count; n++)
            is_done = compute(&self->steps[n], PyTuple_GetItem(self->sequences, n), tick,
                              (char *)memory.buf + self->steps[n].target);
        PyBuffer_Release(&memory);
    }
    if (!is_done)  /* all of it: what is stored twice is the same */
        return PyObject_CallFunctionObjArgs(self->fallback, tick_object, NULL);
    Py_RETURN_NONE;
}

static PyMethodDef steps_methods[] = {
    {"run", (PyCFunction)steps_run, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};
static PyType_Slot steps_slots[] = {
    {Py_tp_new, steps_new}, {Py_tp_dealloc, steps_dealloc}, {Py_tp_methods, steps_methods},
    {0, NULL},
};
PyType_Spec source_steps_spec = {
    "eap._cyclic.SourceSteps", sizeof(SourceSteps), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE, steps_slots,
};
