/* Frames of known layouts, from the socket's memory to the process image.

   eap/pd/subscriber.py is the reference.  Left to it: an unknown or a forgotten layout, another
   source address, a station that does not receive, signatures, polls, alternates, EAP SM, lost or
   reordered frames.  */

#include "cyclic.h"

enum { SM_AT = 13, PD_COMPARED = 6 };
enum { KEY_HEAD = 10, KEY_TAIL = 7 };
enum { RUNNING = 1, NEAR = 0x3FFF };

/* ---- Plan: what becomes of the frames of one layout ---- */

typedef struct {
    int64_t source, target, size;
} Copy;

/* A tracker with its copies, one behind the other as eap/pd/compiledplan.py packs them. */
typedef struct {
    int64_t first;  /* index of the tracker's first word */
    int64_t usual_gap, usual_ns, wrap_ns, step, sender_cycle_ns, own_cycle_ns, copies;
    Copy copy[];
} Part;

typedef struct {
    PyObject_HEAD
    PyObject *watch;
    Py_ssize_t end, header_size, part_size, counter_size;
    int64_t words_needed, memory_needed;
    uint8_t *headers;  /* of all PDs, without quality */
    char *parts;
    int64_t *counters;
} Plan;

static void plan_dealloc(Plan *self) {
    Py_XDECREF(self->watch);
    PyMem_Free(self->headers);
    PyMem_Free(self->parts);
    PyMem_Free(self->counters);
    free_object((PyObject *)self);
}

static Py_ssize_t pd_size(const uint8_t *header) {
    return PD_HEADER + (header[PD_LENGTH] | header[PD_LENGTH + 1] << 8);
}

/* Check all that the plan says before it is used for a frame. */
static int plan_check(Plan *self) {
    Py_ssize_t at = FIRST_PD, rest = self->part_size;
    for (Py_ssize_t n = 0; n < self->header_size; n += PD_COMPARED)
        at += pd_size(self->headers + n);
    if (at > self->end || self->end > MAX_INDEX)
        return refuse("a PD of a plan lies behind the end of its frame");
    for (char *place = self->parts; rest; ) {
        const Part *part = (Part *)place;
        if (rest < (Py_ssize_t)sizeof(Part) || part->copies < 0
            || part->copies > (rest - (Py_ssize_t)sizeof(Part)) / (Py_ssize_t)sizeof(Copy))
            return refuse("a plan is cut off");
        if (!is_time(part->usual_ns) || !is_time(part->own_cycle_ns) || part->wrap_ns < 0
            || part->usual_gap < -1 || !is_time(part->step) || part->sender_cycle_ns < 0
            || part->sender_cycle_ns > MAX_NS >> 16)
            return refuse("a time of a plan is too long");
        if (need(&self->words_needed, part->first, TRACKER_WORDS))
            return -1;
        for (int64_t n = 0; n < part->copies; n++) {
            const Copy *copy = &part->copy[n];
            if (need(&self->memory_needed, copy->target, copy->size))
                return -1;
            if (copy->source < 0 || copy->source > self->end - copy->size)
                return refuse("a copy of a plan lies behind the end of its frame");
        }
        Py_ssize_t size = (Py_ssize_t)(sizeof(Part) + (size_t)part->copies * sizeof(Copy));
        place += size;
        rest -= size;
    }
    for (Py_ssize_t n = 0; n < self->counter_size / WORD; n++)
        if (need(&self->words_needed, self->counters[n], 1))
            return -1;
    return 0;
}

/* Plan(end, headers, parts, counters, watch): bytes of the frame; of each PD the header without its
   quality; trackers with their copies; indexes of words to add one to; an object whose `source` is
   the address that the frames come from.  */
static PyObject *plan_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    const char *headers, *parts, *counters;
    PyObject *watch;
    Plan *self = (Plan *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    self->words_needed = STATION_SEQUENCE + 1;
    if (!PyArg_ParseTuple(args, "ny#y#y#O", &self->end, &headers, &self->header_size, &parts,
                          &self->part_size, &counters, &self->counter_size, &watch))
        goto failed;
    if (!self->header_size || self->header_size % PD_COMPARED || self->counter_size % WORD) {
        refuse("a plan is cut off");
        goto failed;
    }
    Py_INCREF(watch);
    self->watch = watch;
    if ((self->headers = copy_of(headers, self->header_size)) != NULL
        && (self->parts = copy_of(parts, self->part_size)) != NULL
        && (self->counters = copy_of(counters, self->counter_size)) != NULL && !plan_check(self))
        return (PyObject *)self;
failed:
    Py_DECREF(self);
    return NULL;
}

static PyType_Slot plan_slots[] = {
    {Py_tp_new, plan_new}, {Py_tp_dealloc, plan_dealloc}, {0, NULL},
};
PyType_Spec plan_spec = {
    "eap._cyclic.Plan", sizeof(Plan), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE, plan_slots,
};

static const Part *next_part(const Part *part) {
    return (const Part *)(part->copy + part->copies);
}

static const Part *first_part(const Plan *plan) { return (const Part *)plan->parts; }

static const Part *end_of_parts(const Plan *plan) {
    return (const Part *)(plan->parts + plan->part_size);
}

static int plan_matches(const Plan *self, const uint8_t *data, Py_ssize_t size) {
    Py_ssize_t at = FIRST_PD;
    if (self->end > size)
        return 0;
    for (Py_ssize_t n = 0; n < self->header_size; n += PD_COMPARED) {
        if (memcmp(data + at, self->headers + n, PD_COMPARED))
            return 0;
        at += pd_size(self->headers + n);
    }
    return 1;
}

/* ---- SequenceTracker, the usual cases of arrived() ---- */

/* Whether *part* takes a frame as arrived() does without a loss, a reorder or a wrap. */
static int is_usual(const Part *part, const int64_t *words, int cycle, int64_t at_ns) {
    int64_t last = load(&words[part->first + LAST_CYCLE]);
    int64_t before_ns = load(&words[part->first + ARRIVED_AT_NS]);
    if (last < 0)
        return 1;
    if (last > MAX_NS || !is_time(before_ns))
        return 0;
    int64_t elapsed_ns = at_ns - before_ns, gap = (cycle - last) & 0xFFFF;
    if (elapsed_ns > part->wrap_ns)
        return 0;
    return gap == part->usual_gap || (gap <= NEAR && !(part->step && gap >= 2 * part->step));
}

static void enter_jitter(const Part *part, int64_t *tracker, int64_t deviation_ns) {
    if (deviation_ns > part->own_cycle_ns)
        add(&tracker[LATE], 1);
    int64_t micros = (deviation_ns < 0 ? -deviation_ns : deviation_ns) / 1000;
    add(&tracker[JITTER + bin_of(micros)], 1);
    if (micros > load(&tracker[JITTER_MAX_US]))
        store(&tracker[JITTER_MAX_US], micros);
}

static void arrived(const Part *part, int64_t *words, int cycle, int64_t at_ns, int64_t own_cycle) {
    int64_t *tracker = words + part->first;
    int64_t last = load(&tracker[LAST_CYCLE]), position = cycle;
    if (last >= 0) {
        int64_t elapsed_ns = at_ns - load(&tracker[ARRIVED_AT_NS]), gap = (cycle - last) & 0xFFFF;
        if (gap == part->usual_gap)
            enter_jitter(part, tracker, elapsed_ns - part->usual_ns);
        else if (gap == 0)
            add(&tracker[DUPLICATED], 1);
        else if (part->sender_cycle_ns)
            enter_jitter(part, tracker, elapsed_ns - gap * part->sender_cycle_ns);
        position = last + gap;
    }
    add(&tracker[RECEIVED], 1);
    store(&tracker[STATE], RUNNING);
    store(&tracker[LAST_CYCLE], position);
    store(&tracker[ARRIVED_AT_NS], at_ns);
    store(&tracker[ARRIVED_IN_CYCLE], own_cycle);
    store(&tracker[BEHIND], 0);
}

/* ---- PortHandler: receive_frame() of one port ---- */

static int handler_clear(PortHandler *self) {
    Py_CLEAR(self->plans);
    release_buffer(&self->memory);
    release_buffer(&self->words);
    Py_CLEAR(self->fallback);
    Py_CLEAR(self->learner);
    return 0;
}

static int handler_traverse(PortHandler *self, visitproc visit, void *arg) {
    Py_VISIT(Py_TYPE((PyObject *)self));
    Py_VISIT(self->fallback);
    Py_VISIT(self->learner);
    Py_VISIT(self->plans);
    /* Not the memory: it refers to nothing, and CPython must not clear a view that is in use. */
    return 0;
}

static void handler_dealloc(PortHandler *self) {
    PyObject_GC_UnTrack(self);
    if (self->weak_references != NULL)
        PyObject_ClearWeakRefs((PyObject *)self);
    handler_clear(self);
    free_object((PyObject *)self);
}

/* PortHandler(fallback, learner): *fallback* takes what is left to Python, which is everything as long
   as the `wanted` of *learner*, or None, is not empty.  Frames from before open_from_ns are, too.  */
static PyObject *handler_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *fallback, *learner;
    if (!PyArg_ParseTuple(args, "OO", &fallback, &learner))
        return NULL;
    PortHandler *self = (PortHandler *)make_object(type, keywords);
    if (self != NULL) {
        Py_INCREF(fallback);
        self->fallback = fallback;
        Py_INCREF(learner);
        self->learner = learner;
        self->open_from_ns = INT64_MAX;
    }
    return (PyObject *)self;
}

/* attach(plans, memory, words): look for plans there, and write there, from now on. */
static PyObject *handler_attach(PortHandler *self, PyObject *args) {
    PyObject *plans, *memory, *words;
    Py_buffer new_memory = {0}, new_words = {0};
    if (!PyArg_ParseTuple(args, "O!OO", &PyDict_Type, &plans, &memory, &words))
        return NULL;
    if (PyObject_GetBuffer(memory, &new_memory, PyBUF_CONTIG)
        || PyObject_GetBuffer(words, &new_words, PyBUF_CONTIG))
        goto failed;
    if ((uintptr_t)new_words.buf % WORD) {
        refuse("the words of an image are aligned");
        goto failed;
    }
    PyObject *before = self->plans;
    Py_INCREF(plans);
    self->plans = plans;
    release_buffer(&self->memory);
    release_buffer(&self->words);
    self->memory = new_memory;
    self->words = new_words;
    Py_XDECREF(before);
    Py_RETURN_NONE;
failed:
    release_buffer(&new_memory);
    release_buffer(&new_words);
    return NULL;
}

/* detach(): let go of everything; frames are ignored from now on. */
static PyObject *handler_detach(PortHandler *self, PyObject *nothing) {
    (void)nothing;
    handler_clear(self);
    Py_RETURN_NONE;
}

/* Return whether the learner of addresses wants to see frames; -1 for an error. */
static int is_learning(PortHandler *self) {
    if (self->learner == NULL || self->learner == Py_None)
        return 0;
    PyObject *wanted = PyObject_GetAttr(self->learner, text_wanted);
    int result = wanted == NULL ? -1 : PyObject_IsTrue(wanted);
    Py_XDECREF(wanted);
    return result;
}

/* Return the plans of the frames with the key of *data*; NULL if there are none. */
static PyObject *plans_of(PortHandler *self, const uint8_t *data) {
    PyObject *key = Py_BuildValue("(y#y#)", (const char *)data, (Py_ssize_t)KEY_HEAD,
                                  (const char *)data + SM_AT, (Py_ssize_t)KEY_TAIL);
    PyObject *plans = key == NULL ? NULL : PyDict_GetItemWithError(self->plans, key);
    Py_XINCREF(plans);
    Py_XDECREF(key);
    return plans;
}

/* Return whether the frames of *plan* come from *source* as before; -1 for an error. */
static int comes_from(const Plan *plan, const uint8_t *source, Py_ssize_t size) {
    PyObject *known = PyObject_GetAttr(plan->watch, text_source);
    if (known == NULL)
        return -1;
    int same = PyBytes_Check(known) && PyBytes_Size(known) == size
               && !memcmp(PyBytes_AsString(known), source, (size_t)size);
    Py_DECREF(known);
    return same;
}

/* Return the plan of a frame; NULL if Python has to look, or for an error. */
static Plan *find_plan(PortHandler *self, const uint8_t *data, Py_ssize_t size,
                       const uint8_t *source, Py_ssize_t source_size) {
    PyObject *plans = plans_of(self, data), *found = NULL;
    Py_ssize_t count = plans != NULL && PyList_Check(plans) ? PyList_Size(plans) : 0;
    for (Py_ssize_t n = 0; found == NULL && n < count; n++) {
        PyObject *each = PyList_GetItem(plans, n);
        found = each == NULL ? NULL : PyObject_GetAttr(each, text_fast);
        if (found == NULL)
            break;
        /* A plan that Python alone carries out may come first. */
        if (!Py_IS_TYPE(found, plan_type)) {
            Py_CLEAR(found);
            break;
        }
        if (!plan_matches((Plan *)found, data, size))
            Py_CLEAR(found);
    }
    Py_XDECREF(plans);
    if (found != NULL && comes_from((Plan *)found, source, source_size) != 1)
        Py_CLEAR(found);
    return (Plan *)found;
}

Result take(PortHandler *self, const uint8_t *data, Py_ssize_t size, int64_t at_ns,
            const uint8_t *source, Py_ssize_t source_size) {
    if (self->plans == NULL || size < SHORTEST || at_ns < self->open_from_ns || !is_time(at_ns))
        return LEFT_TO_PYTHON;
    int learning = is_learning(self);
    if (learning)
        return learning < 0 ? FAILED : LEFT_TO_PYTHON;
    Plan *plan = find_plan(self, data, size, source, source_size);
    if (plan == NULL)
        return PyErr_Occurred() ? FAILED : LEFT_TO_PYTHON;
    int64_t *words = self->words.buf;
    uint8_t *memory = self->memory.buf;
    int cycle = data[CYCLE_AT] | data[CYCLE_AT + 1] << 8;
    const Part *end = end_of_parts(plan);
    int usual = plan->words_needed <= self->words.len / WORD
                && plan->memory_needed <= self->memory.len;
    for (const Part *part = first_part(plan); usual && part < end; part = next_part(part))
        usual = is_usual(part, words, cycle, at_ns);
    if (!usual) {
        Py_DECREF(plan);
        return LEFT_TO_PYTHON;
    }
    /* A frame taken outside the station's own cycle marks the region as changing itself. */
    int outside = !(load(&words[STATION_SEQUENCE]) & 1);
    if (outside) {
        add(&words[STATION_SEQUENCE], 1);
        __atomic_thread_fence(__ATOMIC_RELEASE);
    }
    int64_t own_cycle = load(&words[STATION_CYCLE]) + outside;
    for (const Part *part = first_part(plan); part < end; part = next_part(part)) {
        arrived(part, words, cycle, at_ns, own_cycle);
        for (int64_t n = 0; n < part->copies; n++)
            memmove(memory + part->copy[n].target, data + part->copy[n].source,
                    (size_t)part->copy[n].size);
    }
    for (Py_ssize_t n = 0; n < plan->counter_size / WORD; n++)
        add(&words[plan->counters[n]], 1);
    if (outside) {
        __atomic_thread_fence(__ATOMIC_RELEASE);
        add(&words[STATION_SEQUENCE], 1);
    }
    Py_DECREF(plan);
    return TAKEN;
}

/* handler(data, size, at_ns, origin): take a frame as receive_frame() does. */
static PyObject *handler_call(PortHandler *self, PyObject *args, PyObject *keywords) {
    PyObject *data, *origin, *number;
    long long at_ns;
    Py_ssize_t size;
    Py_buffer view;
    Result result = LEFT_TO_PYTHON;
    if (keywords != NULL && PyDict_Size(keywords))
        return PyErr_Format(PyExc_TypeError, "a handler takes no keywords");
    if (!PyArg_ParseTuple(args, "OnOO", &data, &size, &number, &origin))
        return NULL;
    at_ns = PyLong_AsLongLong(number);
    if (at_ns == -1 && PyErr_Occurred())
        return NULL;
    if (self->fallback == NULL)
        Py_RETURN_NONE;  /* the port was released */
    if (PyObject_GetBuffer(data, &view, PyBUF_SIMPLE))
        return NULL;
    if (size <= view.len) {
        PyObject *source = PyObject_CallMethodObjArgs(origin, text_source_of, data, NULL);
        if (source == NULL)
            result = FAILED;
        else if (PyBytes_Check(source))
            result = take(self, view.buf, size, at_ns, (uint8_t *)PyBytes_AsString(source),
                          PyBytes_Size(source));
        Py_XDECREF(source);
    }
    PyBuffer_Release(&view);
    if (result == FAILED)
        return NULL;
    if (result == TAKEN)
        Py_RETURN_NONE;
    PyObject *fallback = self->fallback;
    if (fallback == NULL)
        Py_RETURN_NONE;
    Py_INCREF(fallback);
    PyObject *done = PyObject_Call(fallback, args, NULL);
    Py_DECREF(fallback);
    return done;
}

static PyMethodDef handler_methods[] = {
    {"attach", (PyCFunction)handler_attach, METH_VARARGS, NULL},
    {"detach", (PyCFunction)handler_detach, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};
static PyMemberDef handler_members[] = {
    {"open_from_ns", T_LONGLONG, offsetof(PortHandler, open_from_ns), 0, NULL},
    {"__weaklistoffset__", T_PYSSIZET, offsetof(PortHandler, weak_references), READONLY, NULL},
    {NULL, 0, 0, 0, NULL},
};
static PyType_Slot handler_slots[] = {
    {Py_tp_new, handler_new}, {Py_tp_dealloc, handler_dealloc}, {Py_tp_call, handler_call},
    {Py_tp_traverse, handler_traverse}, {Py_tp_clear, handler_clear},
    {Py_tp_methods, handler_methods}, {Py_tp_members, handler_members}, {0, NULL},
};
PyType_Spec handler_spec = {
    "eap._cyclic.PortHandler", sizeof(PortHandler), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_IMMUTABLETYPE, handler_slots,
};
