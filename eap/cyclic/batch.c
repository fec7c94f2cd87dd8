/* Messages of a socket, by batches of recvmmsg, for its handlers.

   eap/net/mmsg.py, udp.py and ethernet.py are the reference.  */

#include "cyclic.h"

#include <netinet/in.h>
#include <time.h>

enum { MAX_BATCHES = 4, CLOCK_NOISE_NS = 1000, SENDER = sizeof(struct sockaddr_in), TAG_AT = 64 };
#define BILLION 1000000000LL

typedef struct {
    PyObject_HEAD
    PyObject *views;
    Py_buffer octets, control, senders;
    struct mmsghdr *headers;
    struct iovec *vectors;
    Py_ssize_t count, buffer_size, headroom, control_size;
    int64_t offset_ns;
    int busy;
} Receiver;

static void receiver_dealloc(Receiver *self) {
    Py_XDECREF(self->views);
    PyMem_Free(self->headers);
    PyMem_Free(self->vectors);
    release_buffer(&self->octets);
    release_buffer(&self->control);
    release_buffer(&self->senders);
    free_object((PyObject *)self);
}

static int64_t clock_ns(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * BILLION + now.tv_nsec;
}

static int64_t measure_offset(int64_t *now_ns) {
    *now_ns = clock_ns(CLOCK_MONOTONIC);
    return *now_ns - clock_ns(CLOCK_REALTIME);
}

/* As ReceiveBatch._read_clocks(). */
static int64_t read_clocks(Receiver *self) {
    int64_t now_ns, later_ns, offset_ns = measure_offset(&now_ns);
    if (offset_ns < self->offset_ns - CLOCK_NOISE_NS) {
        for (int again = 0; again < 3; again++) {
            int64_t other_ns = measure_offset(&later_ns);
            if (other_ns > offset_ns)
                offset_ns = other_ns;
        }
        self->offset_ns = offset_ns;
    } else if (offset_ns > self->offset_ns)
        self->offset_ns = offset_ns;
    return now_ns;
}

/* Let the kernel write into the memory of the batch and nowhere else. */
static int describe(Receiver *self) {
    Py_ssize_t count = self->count = PyList_Size(self->views);
    if (count < 1 || self->octets.len % count || self->control.len != count * self->control_size
        || self->control_size < (Py_ssize_t)(sizeof(struct cmsghdr) + sizeof(struct timespec))
        || self->headroom < 0 || self->headroom > self->octets.len / count - SHORTEST
        || (self->senders.buf != NULL ? self->senders.len != SENDER * count : self->headroom < 12))
        return refuse("a batch has memory for each of its messages");
    self->buffer_size = self->octets.len / count;
    self->headers = PyMem_Calloc((size_t)count, sizeof *self->headers);
    self->vectors = PyMem_Calloc((size_t)count, sizeof *self->vectors);
    if (self->headers == NULL || self->vectors == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t n = 0; n < count; n++) {
        struct msghdr *header = &self->headers[n].msg_hdr;
        self->vectors[n].iov_base = (char *)self->octets.buf + n * self->buffer_size;
        self->vectors[n].iov_len = (size_t)self->buffer_size;
        header->msg_iov = &self->vectors[n];
        header->msg_iovlen = 1;
        header->msg_control = (char *)self->control.buf + n * self->control_size;
        header->msg_controllen = (size_t)self->control_size;
        if (self->senders.buf != NULL) {
            header->msg_name = (char *)self->senders.buf + n * SENDER;
            header->msg_namelen = SENDER;
        }
    }
    return 0;
}

/* Receiver(octets, control, senders, control_size, headroom, views): of a ReceiveBatch. */
static PyObject *receiver_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *octets, *control, *senders, *views;
    Py_ssize_t control_size, headroom;
    if (!PyArg_ParseTuple(args, "OOOnnO!", &octets, &control, &senders, &control_size, &headroom,
                          &PyList_Type, &views))
        return NULL;
    Receiver *self = (Receiver *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    Py_INCREF(views);
    self->views = views;
    self->control_size = control_size;
    self->headroom = headroom;
    int64_t now_ns;
    self->offset_ns = measure_offset(&now_ns);
    if (PyObject_GetBuffer(octets, &self->octets, PyBUF_CONTIG)
        || PyObject_GetBuffer(control, &self->control, PyBUF_CONTIG)
        || (senders != Py_None && PyObject_GetBuffer(senders, &self->senders, PyBUF_CONTIG))
        || describe(self)) {
        Py_DECREF((PyObject *)self);
        return NULL;
    }
    return (PyObject *)self;
}

/* Return when message *n* arrived; one without a stamp shortened its header, which is mended. */
static int64_t arrival_ns(Receiver *self, Py_ssize_t n, int64_t now_ns) {
    struct msghdr *header = &self->headers[n].msg_hdr;
    struct timespec stamp;
    if ((Py_ssize_t)header->msg_controllen != self->control_size) {
        header->msg_controllen = (size_t)self->control_size;
        return now_ns;
    }
    memcpy(&stamp, (char *)self->control.buf + n * self->control_size + sizeof(struct cmsghdr),
           sizeof stamp);
    int64_t at_ns = (int64_t)((uint64_t)stamp.tv_sec * BILLION + (uint64_t)stamp.tv_nsec
                              + (uint64_t)self->offset_ns);
    return at_ns > now_ns ? now_ns : at_ns;
}

/* Hand message *n* to one handler. */
static int hand_over(Receiver *self, Py_ssize_t n, Py_ssize_t size, int64_t at_ns,
                     PyObject *handler, PyObject *origin) {
    const uint8_t *whole = (uint8_t *)self->octets.buf + n * self->buffer_size;
    PyObject *target = handler;
    if (Py_IS_TYPE(handler, handler_type)) {
        const uint8_t *source = self->senders.buf == NULL
                                    ? whole + 6 : (uint8_t *)self->senders.buf + n * SENDER + 4;
        Result result = size > self->buffer_size - self->headroom ? LEFT_TO_PYTHON
                        : take((PortHandler *)handler, whole + self->headroom, size, at_ns, source,
                               self->senders.buf == NULL ? 6 : 4);
        if (result != LEFT_TO_PYTHON)
            return result == FAILED ? -1 : 0;
        target = ((PortHandler *)handler)->fallback;
        if (target == NULL)  /* the port was released */
            return 0;
    }
    Py_INCREF(target);
    PyObject *done = PyObject_CallFunction(target, "OnLO", PyList_GetItem(self->views, n), size,
                                           (long long)at_ns, origin);
    Py_DECREF(target);
    Py_XDECREF(done);
    return done == NULL ? -1 : 0;
}

/* ---- Socket: reading of one socket, and who sends through it ---- */

static int socket_clear(Socket *self) {
    Py_CLEAR(self->handlers);
    return 0;
}

static int socket_traverse(Socket *self, visitproc visit, void *arg) {
    Py_VISIT(Py_TYPE((PyObject *)self));
    Py_VISIT(self->handlers);
    return 0;
}

static void socket_dealloc(Socket *self) {
    PyObject_GC_UnTrack(self);
    socket_clear(self);
    Py_XDECREF(self->receiver);
    Py_XDECREF(self->origin);
    Py_XDECREF(self->sender);
    free_object((PyObject *)self);
}

/* Socket(receiver, fd, handlers, origin, sender): *handlers* is a list, or those of a packet socket
   by VLAN and address.  To *origin*, of which only a weak reference is kept, the frames are said to
   belong; its drain() is called unless may_drain.  *sender* is its SendBatch.  */
static PyObject *socket_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *receiver, *handlers, *origin, *sender;
    int fd;
    if (!PyArg_ParseTuple(args, "O!iOOO", receiver_type, &receiver, &fd, &handlers, &origin,
                          &sender))
        return NULL;
    const Receiver *batch = (Receiver *)receiver;
    if (PyDict_Check(handlers) ? batch->control_size < TAG_AT + 2
                               : !PyList_Check(handlers) || batch->senders.buf == NULL)
        return PyErr_Format(PyExc_TypeError, "a list of handlers, or routes of a packet socket");
    Socket *self = (Socket *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    Py_INCREF(receiver);
    self->receiver = receiver;
    Py_INCREF(handlers);
    self->handlers = handlers;
    Py_INCREF(sender);
    self->sender = sender;
    self->fd = fd;
    self->may_drain = self->may_send = 1;
    if ((self->origin = PyWeakref_NewRef(origin, NULL)) == NULL)
        Py_CLEAR(self);
    return (PyObject *)self;
}

/* Return the handlers of message *n* by routes, borrowed; NULL if there are none. */
static PyObject *handlers_for(Receiver *self, PyObject *routes, Py_ssize_t n) {
    uint64_t head, mask = 0;
    uint16_t tag;
    memset(&mask, 0xFF, 6);
    memcpy(&head, (char *)self->octets.buf + n * self->buffer_size, sizeof head);
    memcpy(&tag, (char *)self->control.buf + n * self->control_size + TAG_AT, sizeof tag);
    PyObject *vlan = PyLong_FromLong(tag & 0x0FFF);
    if (vlan == NULL)
        return NULL;
    PyObject *found = PyDict_GetItemWithError(routes, vlan);
    Py_DECREF(vlan);
    if (found == NULL || !PyDict_Check(found))
        return NULL;
    PyObject *address = PyLong_FromUnsignedLongLong(head & mask);
    if (address == NULL)
        return NULL;
    found = PyDict_GetItemWithError(found, address);
    Py_DECREF(address);
    return found;
}

/* Hand a batch over; return how many messages had a handler, -1 for an error. */
static Py_ssize_t hand_over_batch(Receiver *self, Py_ssize_t count, PyObject *handlers,
                                  PyObject *origin) {
    int64_t now_ns = read_clocks(self);
    Py_ssize_t taken = 0;
    for (Py_ssize_t n = 0; n < count; n++) {
        int64_t at_ns = arrival_ns(self, n, now_ns);
        PyObject *list = handlers;
        if (PyDict_Check(handlers) && (list = handlers_for(self, handlers, n)) == NULL) {
            PyObject *counted = PyErr_Occurred()
                                    ? NULL : PyObject_CallMethod(origin, "count_unrouted", "n", n);
            Py_XDECREF(counted);
            if (counted == NULL)
                return -1;
            continue;
        }
        if (!PyList_Check(list))
            return refuse("handlers are in a list");
        Py_INCREF(list);  /* a handler may exchange it */
        int failed = 0;
        taken += PyList_Size(list) > 0;
        for (Py_ssize_t i = 0; !failed && i < PyList_Size(list); i++) {
            PyObject *handler = PyList_GetItem(list, i);
            Py_INCREF(handler);
            failed = hand_over(self, n, (Py_ssize_t)self->headers[n].msg_len - self->headroom,
                               at_ns, handler, origin);
            Py_DECREF(handler);
        }
        Py_DECREF(list);
        if (failed)
            return -1;
    }
    return taken;
}

/* Read at most MAX_BATCHES; *handlers* and *origin* stay alive. */
static Py_ssize_t receive_batches(Receiver *self, int fd, PyObject *handlers, PyObject *origin) {
    Py_ssize_t total = 0;
    for (int batch = 0; batch < MAX_BATCHES; batch++) {
        int count = recvmmsg(fd, self->headers, (unsigned)self->count, MSG_DONTWAIT, NULL);
        if (count < 0 && errno == EAGAIN)
            break;
        if (count < 0) {
            PyObject *again = PyObject_CallMethod(origin, "note_error", "i", errno);
            int goes_on = again == NULL ? -1 : PyObject_IsTrue(again);
            Py_XDECREF(again);
            if (goes_on < 0)
                return -1;
            if (!goes_on)
                break;
            continue;
        }
        Py_ssize_t taken = hand_over_batch(self, count, handlers, origin);
        if (taken < 0)
            return -1;
        total += taken;
        if (count == 1 || count < self->count)
            break;
    }
    return total;
}

Py_ssize_t drain(Socket *self) {
    Receiver *receiver = (Receiver *)self->receiver;
    PyObject *origin = PyWeakref_GetObject(self->origin), *handlers = self->handlers;
    if (origin == Py_None || handlers == NULL)
        return 0;
    Py_ssize_t total = -1;
    Py_INCREF((PyObject *)self);
    Py_INCREF(origin);
    Py_INCREF(handlers);
    if (!self->may_drain) {
        PyObject *count = PyObject_CallMethod(origin, "drain", NULL);
        total = count == NULL ? -1 : PyLong_AsSsize_t(count);
        Py_XDECREF(count);
    } else if (receiver->busy)
        PyErr_Format(PyExc_RuntimeError, "the batch is in use");
    else {
        receiver->busy = 1;
        total = receive_batches(receiver, self->fd, handlers, origin);
        receiver->busy = 0;
    }
    Py_DECREF(handlers);
    Py_DECREF(origin);
    Py_DECREF((PyObject *)self);
    return total;
}

/* socket(now_ns) */
static PyObject *socket_call(Socket *self, PyObject *args, PyObject *keywords) {
    (void)args;
    (void)keywords;
    Py_ssize_t total = drain(self);
    return total < 0 ? NULL : PyLong_FromSsize_t(total);
}

static PyType_Slot receiver_slots[] = {
    {Py_tp_new, receiver_new}, {Py_tp_dealloc, receiver_dealloc}, {0, NULL},
};
PyType_Spec receiver_spec = {
    "eap._cyclic.Receiver", sizeof(Receiver), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    receiver_slots,
};
static PyMemberDef socket_members[] = {
    {"may_drain", T_BOOL, offsetof(Socket, may_drain), 0, NULL},
    {"may_send", T_BOOL, offsetof(Socket, may_send), 0, NULL},
    {NULL, 0, 0, 0, NULL},
};
static PyType_Slot socket_slots[] = {
    {Py_tp_new, socket_new}, {Py_tp_dealloc, socket_dealloc}, {Py_tp_call, socket_call},
    {Py_tp_traverse, socket_traverse}, {Py_tp_clear, socket_clear},
    {Py_tp_members, socket_members}, {0, NULL},
};
PyType_Spec socket_spec = {
    "eap._cyclic.Socket", sizeof(Socket), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_IMMUTABLETYPE, socket_slots,
};
