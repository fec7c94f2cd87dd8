/* The cycle of a station: Station.cycle(), which is the reference.

   Its steps are objects of Python; those that are compiled run without a detour.  */

#include "cyclic.h"

/* Lists of steps, which change between two cycles; single steps, of which two may be None. */
enum { DRAINS, RARELY, SUPERVISORS, CLOSING, OUTLETS, LISTS };
enum { GENERATE, RUN_LINKS, REFRESH, READ_CONTROLS, SAMPLE, WAKE, PARTS };

typedef struct {
    PyObject *held;
    Py_ssize_t count;
    PyObject **items;  /* of *held*: to read a list of Python takes longer than a step */
} Steps;

typedef struct {
    PyObject_HEAD
    Py_buffer buffer;
    Steps steps[LISTS];
    Outlet *outlets;
    PyObject *parts[PARTS];
    long long rarely_every;
    int64_t settled[2];
    char sends, is_running;
} Cycle;

static void clear_steps(Steps *steps) {
    steps->count = 0;
    Py_CLEAR(steps->held);
    PyMem_Free(steps->items);
    steps->items = NULL;
}

static int cycle_clear(Cycle *self) {
    for (int n = 0; n < LISTS; n++)
        clear_steps(&self->steps[n]);
    for (int n = 0; n < PARTS; n++)
        Py_CLEAR(self->parts[n]);
    return 0;
}

static int cycle_traverse(Cycle *self, visitproc visit, void *arg) {
    Py_VISIT(Py_TYPE((PyObject *)self));
    for (int n = 0; n < LISTS; n++)
        Py_VISIT(self->steps[n].held);
    for (int n = 0; n < PARTS; n++)
        Py_VISIT(self->parts[n]);
    return 0;
}

static void cycle_dealloc(Cycle *self) {
    PyObject_GC_UnTrack(self);
    cycle_clear(self);
    PyMem_Free(self->outlets);
    release_buffer(&self->buffer);
    free_object((PyObject *)self);
}

/* Cycle(words, rarely_every, parts): words of the image, and PARTS objects. */
static PyObject *cycle_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *words, *parts;
    long long rarely_every;
    if (!PyArg_ParseTuple(args, "OLO!", &words, &rarely_every, &PyTuple_Type, &parts))
        return NULL;
    Cycle *self = (Cycle *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    const int fits = PyTuple_Size(parts) == PARTS && rarely_every > 0;
    for (int n = 0; fits && n < PARTS; n++) {
        self->parts[n] = PyTuple_GetItem(parts, n);
        Py_INCREF(self->parts[n]);
    }
    self->rarely_every = rarely_every;
    self->settled[0] = self->settled[1] = -1;
    if (!PyObject_GetBuffer(words, &self->buffer, PyBUF_CONTIG)) {
        if (fits && self->buffer.len >= STATION_WORDS * WORD
            && !((uintptr_t)self->buffer.buf % WORD))
            return (PyObject *)self;
        refuse("a cycle has the words of an image, and steps");
    }
    Py_DECREF(self);
    return NULL;
}

static int hold(Steps *steps, PyObject *list) {
    if ((steps->held = PySequence_Tuple(list)) == NULL)
        return -1;
    steps->count = PyTuple_Size(steps->held);
    steps->items = PyMem_Calloc((size_t)steps->count + 1, sizeof *steps->items);
    if (steps->items == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t n = 0; n < steps->count; n++)
        steps->items[n] = PyTuple_GetItem(steps->held, n);
    return 0;
}

/* Read the outlets, which are tuples of four. */
static int hold_outlets(Cycle *self) {
    const Steps *all = &self->steps[OUTLETS];
    PyMem_Free(self->outlets);
    if ((self->outlets = PyMem_Calloc((size_t)all->count + 1, sizeof *self->outlets)) == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t n = 0; n < all->count; n++) {
        Outlet *to = &self->outlets[n];
        if (!PyTuple_Check(all->items[n])
            || !PyArg_ParseTuple(all->items[n], "OOOO", &to->publisher, &to->channel, &to->plan,
                                 &to->socket))
            return PyErr_Occurred() ? -1 : refuse("a cycle has outlets of four parts");
    }
    return 0;
}

/* attach(drains, rarely, supervisors, closing, outlets): go through these from now on. */
static PyObject *cycle_attach(Cycle *self, PyObject *args) {
    PyObject *lists[LISTS];
    if (!PyArg_ParseTuple(args, "OOOOO", &lists[0], &lists[1], &lists[2], &lists[3], &lists[4]))
        return NULL;
    if (self->is_running)
        return PyErr_Format(PyExc_RuntimeError, "the steps of a cycle do not change while it runs");
    int failed = 0;
    for (int n = 0; n < LISTS; n++) {
        clear_steps(&self->steps[n]);
        failed = failed || hold(&self->steps[n], lists[n]);
    }
    if (failed || hold_outlets(self)) {
        clear_steps(&self->steps[OUTLETS]);
        return NULL;
    }
    Py_RETURN_NONE;
}

/* Call a step; return whether its result is true, or -1. */
static int call(PyObject *step, PyObject *argument) {
    PyObject *result = PyObject_CallFunctionObjArgs(step, argument, NULL);
    int is_true = result == NULL ? -1 : PyObject_IsTrue(result);
    Py_XDECREF(result);
    return is_true;
}

static int call_all(const Steps *steps, PyObject *now) {
    int failed = 0;
    for (Py_ssize_t n = 0; !failed && n < steps->count; n++) {
        PyObject *step = steps->items[n];
        failed = (Py_IS_TYPE(step, socket_type) ? drain((Socket *)step) : call(step, now)) < 0;
    }
    return failed ? -1 : 0;
}

/* As Inputs.refresh(), which is called unless nothing was written since it has copied all. */
static int refresh(Cycle *self) {
    const int64_t *words = (int64_t *)self->buffer.buf + STATION_SERVICES;
    int64_t before[] = {load(&words[0]), load(&words[1])};
    if (before[0] == self->settled[0] && before[1] == self->settled[1])
        return 0;
    int changed = call(self->parts[REFRESH], NULL);
    /* Odd while somebody writes; another value if that has begun meanwhile. */
    if (changed >= 0 && !((before[0] | before[1]) & 1) && before[0] == load(&words[0])
        && before[1] == load(&words[1]))
        memcpy(self->settled, before, sizeof before);
    return changed;
}

static int compute(Cycle *self, int64_t number) {
    PyObject *links = self->parts[RUN_LINKS];
    if (self->parts[GENERATE] == Py_None)
        return refresh(self);
    PyObject *count = PyLong_FromLongLong(number);
    int changed = count == NULL || call(self->parts[GENERATE], count) < 0 ? -1 : refresh(self);
    Py_XDECREF(count);
    return changed < 0 || links == Py_None || call(links, NULL) >= 0 ? changed : -1;
}

/* As Station._write_own_variables(). */
static int write_own_variables(Cycle *self, int64_t cycle, int is_rare, PyObject *now) {
    int64_t *words = self->buffer.buf, sequence = load(&words[STATION_SEQUENCE]);
    store(&words[STATION_SEQUENCE], sequence + 1);
    __atomic_thread_fence(__ATOMIC_RELEASE);
    if (call_all(&self->steps[DRAINS], now) || (is_rare && call_all(&self->steps[RARELY], now))
        || call_all(&self->steps[SUPERVISORS], now))
        return -1;
    int changed = compute(self, cycle + load(&words[STATION_OVERRUNS]));
    if (changed >= 0)
        __atomic_store_n(&words[STATION_SEQUENCE], sequence + 2, __ATOMIC_RELEASE);
    return changed;
}

/* Send the frames of one publisher that are due, as Python does. */
static int send_by_python(const Outlet *outlet, const Moment *moment) {
    PyObject *failed = NULL, *done = NULL;
    PyObject *frames = PyObject_CallMethod(outlet->publisher, "frames_to_send", "LO",
                                           (long long)moment->number, moment->now);
    int any = frames == NULL ? -1 : PyObject_IsTrue(frames);
    if (any > 0) {
        failed = PyObject_CallMethod(outlet->channel, "send", "OO", frames, moment->now);
        if (failed != NULL)
            done = PyObject_CallMethod(outlet->publisher, "sent", "OO", failed, moment->now);
        any = done == NULL ? -1 : 0;
    }
    Py_XDECREF(done);
    Py_XDECREF(failed);
    Py_XDECREF(frames);
    return any;
}

static int send_all(Cycle *self, const Moment *moment) {
    int failed = 0;
    for (Py_ssize_t n = 0; !failed && n < self->steps[OUTLETS].count; n++) {
        Result result = send_due(&self->outlets[n], moment);
        failed = result == LEFT_TO_PYTHON ? send_by_python(&self->outlets[n], moment)
                                          : result == FAILED;
    }
    return failed ? -1 : 0;
}

static int end_cycle(Cycle *self, const Moment *moment, int64_t late_ns) {
    int64_t *words = self->buffer.buf;
    add(&words[STATION_LATENESS + bin_of(late_ns / 1000)], 1);
    if (late_ns > load(&words[STATION_LATENESS_MAX_NS]))
        store(&words[STATION_LATENESS_MAX_NS], late_ns);
    if (moment->number <= load(&words[STATION_SAMPLED_UNTIL])) {
        PyObject *done = PyObject_CallFunction(self->parts[SAMPLE], "LO",
                                               (long long)moment->number, moment->now);
        Py_XDECREF(done);
        if (done == NULL)
            return -1;
    }
    /* All of the cycle first: snapshots are taken while this word agrees with the counter. */
    __atomic_store_n(&words[STATION_FUTEX], moment->number & 0xFFFFFFFF, __ATOMIC_RELEASE);
    if (moment->number - load(&words[STATION_WAITERS]) <= WAKE_FOR_CYCLES)
        return call(self->parts[WAKE], NULL) < 0 ? -1 : 0;
    return 0;
}

static int run(Cycle *self, const Moment *moment, int64_t due_ns, int64_t behind_ns) {
    int64_t *words = self->buffer.buf;
    store(&words[STATION_CYCLE], moment->number);
    store(&words[STATION_CYCLE_AT_NS], due_ns);
    __atomic_thread_fence(__ATOMIC_RELEASE);
    const int is_rare = !(moment->number % self->rarely_every);
    const int has_own = self->parts[GENERATE] != Py_None || self->steps[DRAINS].count;
    int changed = has_own || is_rare
                      ? write_own_variables(self, moment->number, is_rare, moment->now)
                      : refresh(self);
    return changed < 0 || (changed && call(self->parts[READ_CONTROLS], NULL) < 0)
           || (self->sends && send_all(self, moment))
           || call_all(&self->steps[CLOSING], moment->now)
           || end_cycle(self, moment, moment->now_ns - due_ns - behind_ns);
}

/* run(due_ns, now_ns, behind_ns=0) */
static PyObject *cycle_run(Cycle *self, PyObject *const *args, Py_ssize_t count) {
    if (count < 2 || count > 3)
        return PyErr_Format(PyExc_TypeError, "a cycle takes two or three times");
    int64_t due_ns = PyLong_AsLongLong(args[0]), now_ns = PyLong_AsLongLong(args[1]);
    int64_t behind_ns = count == 3 ? PyLong_AsLongLong(args[2]) : 0;
    if ((due_ns == -1 || now_ns == -1 || behind_ns == -1) && PyErr_Occurred())
        return NULL;
    if (self->is_running)
        return PyErr_Format(PyExc_RuntimeError, "the cycle runs already");
    const Moment moment = {load((int64_t *)self->buffer.buf + STATION_CYCLE) + 1, now_ns, args[1]};
    self->is_running = 1;
    int failed = run(self, &moment, due_ns, behind_ns);
    self->is_running = 0;
    if (failed)
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef cycle_methods[] = {
    {"attach", (PyCFunction)cycle_attach, METH_VARARGS, NULL},
    {"run", (PyCFunction)(void (*)(void))cycle_run, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};
static PyMemberDef cycle_members[] = {
    {"sends", T_BOOL, offsetof(Cycle, sends), 0, NULL},
    {NULL, 0, 0, 0, NULL},
};
static PyType_Slot cycle_slots[] = {
    {Py_tp_new, cycle_new}, {Py_tp_dealloc, cycle_dealloc}, {Py_tp_traverse, cycle_traverse},
    {Py_tp_clear, cycle_clear}, {Py_tp_methods, cycle_methods}, {Py_tp_members, cycle_members},
    {0, NULL},
};
PyType_Spec cycle_spec = {
    "eap._cyclic.Cycle", sizeof(Cycle), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_IMMUTABLETYPE, cycle_slots,
};
