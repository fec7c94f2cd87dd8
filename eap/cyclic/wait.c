/* Wait of the engine's loop; eap/net/ticker.py is the reference. */

#include "cyclic.h"

#include <sys/epoll.h>
#include <sys/timerfd.h>
#include <time.h>

#define BILLION 1000000000LL
/* A wait that polls ends after this time at the latest, so that signals are handled. */
#define LONGEST_POLL_NS 50000000LL

typedef struct {
    PyObject_HEAD
    int epoll, timer, count;
    long long long_ns, lead_ns;
    Py_buffer events;
} Waiter;

static void waiter_dealloc(Waiter *self) {
    release_buffer(&self->events);
    free_object((PyObject *)self);
}

/* Waiter(epoll, timer, events, long_ns, lead_ns): descriptors of both, the first registered with the
   other; memory of the events of a wait; a wait longer than *long_ns* has a part that ends
   *lead_ns* before the deadline.  The owner closes the descriptors.  */
static PyObject *waiter_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    int epoll, timer;
    PyObject *events;
    long long long_ns, lead_ns;
    if (!PyArg_ParseTuple(args, "iiOLL", &epoll, &timer, &events, &long_ns, &lead_ns))
        return NULL;
    Waiter *self = (Waiter *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    self->epoll = epoll;
    self->timer = timer;
    self->long_ns = long_ns;
    self->lead_ns = lead_ns;
    if (PyObject_GetBuffer(events, &self->events, PyBUF_CONTIG))
        goto failed;
    if (self->events.len < (Py_ssize_t)sizeof(struct epoll_event) || self->events.len > MAX_INDEX
        || long_ns < lead_ns || lead_ns < 0) {
        refuse("a wait has memory for an event, and a lead shorter than itself");
        goto failed;
    }
    return (PyObject *)self;
failed:
    Py_DECREF(self);
    return NULL;
}

static int64_t read_clock(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * BILLION + now.tv_nsec;
}

static int look(Waiter *self, int timeout) {
    int most = (int)(self->events.len / (Py_ssize_t)sizeof(struct epoll_event));
    int count = epoll_wait(self->epoll, self->events.buf, most, timeout);
    return self->count = count < 0 ? 0 : count;
}

static void set_timer(Waiter *self, int64_t at_ns) {
    struct itimerspec at = {.it_value = {at_ns / BILLION, at_ns % BILLION}};
    timerfd_settime(self->timer, TFD_TIMER_ABSTIME, &at, NULL);
}

/* Sleep until *at_ns* or an event; return the time then if *at_ns* has come, else 0. */
static int64_t sleep_until(Waiter *self, int64_t at_ns) {
    set_timer(self, at_ns);
    look(self, -1);
    int64_t now_ns = read_clock();
    return now_ns >= at_ns ? now_ns : 0;
}

/* The same without sleep. */
static int64_t poll_until(Waiter *self, int64_t at_ns, int64_t now_ns) {
    int64_t until_ns = now_ns + LONGEST_POLL_NS;
    set_timer(self, 0);  /* it has expired, and would be found again and again */
    while (now_ns < at_ns && now_ns < until_ns && !look(self, 0))
        now_ns = read_clock();
    return now_ns >= at_ns ? now_ns : 0;
}

static int64_t wait_until(Waiter *self, int64_t at_ns, int polls) {
    int64_t now_ns = read_clock(), rest_ns = at_ns - now_ns;
    if (rest_ns <= 0)
        return now_ns;
    if (polls) {
        now_ns = sleep_until(self, now_ns + rest_ns / 10);
        return now_ns ? poll_until(self, at_ns, now_ns) : 0;
    }
    if (rest_ns > self->long_ns && !sleep_until(self, at_ns - self->lead_ns))
        return 0;
    return sleep_until(self, at_ns);
}

/* wait(deadline_ns, polls): the time once *deadline_ns* has passed, 0 if something else came first.
   With *polls* it sleeps in the first tenth of the wait only.  */
static PyObject *waiter_wait(Waiter *self, PyObject *args) {
    long long deadline_ns;
    int polls = 0;
    if (!PyArg_ParseTuple(args, "L|p", &deadline_ns, &polls))
        return NULL;
    int64_t now_ns, at_ns = deadline_ns < MAX_NS ? deadline_ns : MAX_NS;
    self->count = 0;
    Py_BEGIN_ALLOW_THREADS
    now_ns = wait_until(self, at_ns, polls);
    Py_END_ALLOW_THREADS
    /* Here as in a wait of Python: its handlers have run when this returns. */
    return PyErr_CheckSignals() ? NULL : PyLong_FromLongLong(now_ns);
}

static PyMethodDef waiter_methods[] = {
    {"wait", (PyCFunction)waiter_wait, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};
static PyMemberDef waiter_members[] = {
    {"count", T_INT, offsetof(Waiter, count), READONLY, NULL},
    {NULL, 0, 0, 0, NULL},
};
static PyType_Slot waiter_slots[] = {
    {Py_tp_new, waiter_new}, {Py_tp_dealloc, waiter_dealloc}, {Py_tp_methods, waiter_methods},
    {Py_tp_members, waiter_members}, {0, NULL},
};
PyType_Spec waiter_spec = {
    "eap._cyclic.Waiter", sizeof(Waiter), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    waiter_slots,
};
