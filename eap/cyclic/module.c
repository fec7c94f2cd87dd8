/* The module eap._cyclic. */

#include "cyclic.h"

#include <stdlib.h>

/* Parameters, plans and offsets as eap/compiled.py gives them; raised when either side changes. */
#define API 10

PyTypeObject *plan_type, *handler_type, *receiver_type, *socket_type, *patch_type, *send_plan_type;
static PyTypeObject *cycle_type, *waiter_type, *cycle_frame_type, *copies_type, *source_steps_type;
PyObject *text_fast, *text_source, *text_source_of, *text_wanted;

static const struct {
    PyType_Spec *spec;
    PyTypeObject **type;
} types[] = {
    {&plan_spec, &plan_type},         {&handler_spec, &handler_type},
    {&receiver_spec, &receiver_type}, {&socket_spec, &socket_type},
    {&patch_spec, &patch_type},       {&send_plan_spec, &send_plan_type},
    {&cycle_spec, &cycle_type},       {&waiter_spec, &waiter_type},
    {&cycle_frame_spec, &cycle_frame_type},
    {&copies_spec, &copies_type},     {&source_steps_spec, &source_steps_type},
};

static const struct {
    PyObject **text;
    const char *value;
} texts[] = {
    {&text_fast, "fast"},
    {&text_source, "source"},
    {&text_source_of, "source_of"},
    {&text_wanted, "wanted"},
};

/* In the order of eap/pd/compiledplan.py. */
static const int offsets[] = {
    STATION_CYCLE, STATION_CYCLE_AT_NS, STATION_FUTEX, STATION_WAITERS, STATION_SEQUENCE,
    STATION_SERVICES, STATION_APPLICATION, STATION_OVERRUNS, STATION_LATENESS_MAX_NS,
    STATION_LATENESS, STATION_SAMPLED_UNTIL, RX_TRACKER, RX_RESPONSE_NS, RX_RECEIVED,
    RX_WORDS, DUPLICATED, LATE, STATE, LAST_CYCLE, ARRIVED_AT_NS, ARRIVED_IN_CYCLE, BEHIND,
    JITTER_MAX_US, JITTER, TRACKER_WORDS, CYCLE_AT, FIRST_PD, QUALITY_MAX, QUALITY_NS,
    WAKE_FOR_CYCLES,
};

int refuse(const char *what) {
    PyErr_SetString(PyExc_ValueError, what);
    return -1;
}

int need(int64_t *needed, int64_t first, int64_t count) {
    if (first < 0 || count < 0 || first > MAX_INDEX || count > MAX_INDEX)
        return refuse("a plan reaches outside of the image");
    if (first + count > *needed)
        *needed = first + count;
    return 0;
}

PyObject *make_object(PyTypeObject *type, PyObject *keywords) {
    if (keywords != NULL && PyDict_Size(keywords))
        return PyErr_Format(PyExc_TypeError, "there are no keywords");
    return ((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, 0);
}

void free_object(PyObject *self) {
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

void *copy_of(const char *octets, Py_ssize_t size) {
    void *copy = PyMem_Malloc((size_t)size + 1);
    if (copy == NULL)
        PyErr_NoMemory();
    else
        memcpy(copy, octets, (size_t)size);
    return copy;
}

void release_buffer(Py_buffer *buffer) {
    PyBuffer_Release(buffer);
    memset(buffer, 0, sizeof *buffer);
}

static int fill(PyObject *module) {
    for (size_t n = 0; n < sizeof texts / sizeof *texts; n++)
        if ((*texts[n].text = PyUnicode_InternFromString(texts[n].value)) == NULL)
            return -1;
    for (size_t n = 0; n < sizeof types / sizeof *types; n++) {
        PyObject *type = PyType_FromSpec(types[n].spec);
        const char *name = strrchr(types[n].spec->name, '.') + 1;
        if (type == NULL || PyModule_AddObjectRef(module, name, type))
            return -1;
        *types[n].type = (PyTypeObject *)type;
    }
    Py_ssize_t count = sizeof offsets / sizeof *offsets;
    PyObject *all = PyTuple_New(count);
    for (Py_ssize_t n = 0; all != NULL && n < count; n++)
        if (PyTuple_SetItem(all, n, PyLong_FromLong(offsets[n])))
            Py_CLEAR(all);
    int failed = all == NULL || PyModule_AddObjectRef(module, "OFFSETS", all);
    Py_XDECREF(all);
    return failed ? -1 : PyModule_AddIntConstant(module, "API", API);
}

/* keep_order(): as eap/pd/ordering.py says. */
static PyObject *keep_order(PyObject *module, PyObject *nothing) {
    (void)module;
    (void)nothing;
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"keep_order", keep_order, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "eap._cyclic", "Compiled part of the cyclic path.", -1,
    functions, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__cyclic(void) {
    const char *pure = getenv("EAP_PURE");
    if (pure != NULL && *pure && strcmp(pure, "0"))
        return PyErr_Format(PyExc_ImportError, "EAP_PURE is set");
    PyObject *module = PyModule_Create(&definition);
    if (module != NULL && fill(module)) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
