/* Frames of a port, from the process image to the socket.

   eap/pd/txframe.py, publisher.py and eap/net/mmsg.py are the reference.  Left to them: frames that
   a change or an event may send, answers to polls, frames that the kernel does not take, and
   channels that do more than hand frames to a socket.  */

#include "cyclic.h"

/* ---- Patch: what a cycle writes into one prebuilt frame ---- */

/* Bits of the image (from 0), or of the inputs (from 1), and their place in the frame. */
typedef struct {
    int64_t from, source, target, bits;
} Move;

/* One origin of the values of a PD whose quality is at *target*: *word* is the first word of its
   subscription, whose header is at *header* of the image; -1 for a value of a controller.  */
typedef struct {
    int64_t target, word, header;
} Origin;

typedef struct {
    PyObject_HEAD
    Py_buffer frame, memory[2], words;
    int64_t cycle_at, cycle_ns;
    Py_ssize_t move_size, origin_size;
    Move *moves;
    Origin *origins;
} Patch;

static void patch_dealloc(Patch *self) {
    release_buffer(&self->frame);
    release_buffer(&self->memory[0]);
    release_buffer(&self->memory[1]);
    release_buffer(&self->words);
    PyMem_Free(self->moves);
    PyMem_Free(self->origins);
    free_object((PyObject *)self);
}

static int is_whole(const Move *move) { return !((move->source | move->target | move->bits) & 7); }

static int is_within(int64_t first, int64_t count, int64_t size) {
    return first >= 0 && count >= 0 && first <= size && count <= size - first;
}

/* Check all that the patch says before it is used. */
static int patch_check(const Patch *self) {
    const int64_t frame = self->frame.len, words = self->words.len / WORD;
    if (!is_within(self->cycle_at, 2, frame) || self->cycle_ns < 1 || self->cycle_ns > MAX_NS
        || words < STATION_WORDS || (uintptr_t)self->words.buf % WORD
        || self->move_size % (Py_ssize_t)sizeof(Move)
        || self->origin_size % (Py_ssize_t)sizeof(Origin))
        return refuse("a patch is cut off");
    for (Py_ssize_t n = 0; n < self->move_size / (Py_ssize_t)sizeof(Move); n++) {
        const Move *move = &self->moves[n];
        if ((move->from != 0 && move->from != 1)
            || !is_within(move->source, move->bits, 8 * self->memory[move->from].len)
            || !is_within(move->target, move->bits, 8 * frame)
            || !(is_whole(move) || move->bits <= 8))
            return refuse("a patch reaches outside of its frame or image");
    }
    for (Py_ssize_t n = 0; n < self->origin_size / (Py_ssize_t)sizeof(Origin); n++) {
        const Origin *origin = &self->origins[n];
        if (!is_within(origin->target, 2, frame)
            || !is_within(origin->word, origin->header < 0 ? 1 : RX_WORDS, words)
            || (origin->header >= 0
                && !is_within(origin->header, PD_HEADER, self->memory[0].len)))
            return refuse("a patch reaches outside of its frame or image");
    }
    return 0;
}

/* Patch(frame, cycle_at, memories, words, cycle_ns, moves, origins): buffer of the frame, offset of
   its cycle counter; image and inputs; words of the image; the station's cycle time.  */
static PyObject *patch_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *frame, *image, *inputs, *words;
    const char *moves, *origins;
    long long cycle_at, cycle_ns;
    Patch *self = (Patch *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    if (PyArg_ParseTuple(args, "OL(OO)OLy#y#", &frame, &cycle_at, &image, &inputs, &words,
                         &cycle_ns, &moves, &self->move_size, &origins, &self->origin_size)
        && !PyObject_GetBuffer(frame, &self->frame, PyBUF_CONTIG)
        && !PyObject_GetBuffer(image, &self->memory[0], PyBUF_CONTIG_RO)
        && !PyObject_GetBuffer(inputs, &self->memory[1], PyBUF_CONTIG_RO)
        && !PyObject_GetBuffer(words, &self->words, PyBUF_CONTIG_RO)
        && (self->moves = copy_of(moves, self->move_size)) != NULL
        && (self->origins = copy_of(origins, self->origin_size)) != NULL) {
        self->cycle_at = cycle_at;
        self->cycle_ns = cycle_ns;
        if (!patch_check(self))
            return (PyObject *)self;
    }
    Py_DECREF(self);
    return NULL;
}

/* As Gather.bits_into(), for one variable. */
static void move_bits(const Move *move, const uint8_t *memory, uint8_t *frame) {
    const unsigned mask = (1u << move->bits) - 1;
    const uint8_t *source = memory + (move->source >> 3);
    uint8_t *target = frame + (move->target >> 3);
    unsigned shift = move->source & 7, value = source[0];
    if (shift + move->bits > 8)
        value |= (unsigned)source[1] << 8;
    value = value >> shift & mask;
    shift = move->target & 7;
    target[0] = (uint8_t)((target[0] & ~(mask << shift)) | value << shift);
    if (shift + move->bits > 8)
        target[1] = (uint8_t)((target[1] & ~(mask << shift >> 8)) | value << shift >> 8);
}

/* As quality() and field_quality(). */
static int64_t quality_of(const Patch *self, const Origin *origin) {
    const int64_t *words = self->words.buf;
    if (origin->header < 0) {
        int64_t at_ns = load(&words[origin->word]);
        int64_t age_ns = load(&words[STATION_CYCLE_AT_NS]) - at_ns;
        return at_ns == 0 ? QUALITY_MAX : age_ns < 0 ? 0 : age_ns / QUALITY_NS;
    }
    int64_t first = load(&words[origin->word + RX_TRACKER]);
    if (first == 0)
        first = origin->word;
    if (!is_within(first, RX_WORDS, self->words.len / WORD)
        || !load(&words[first + RX_RECEIVED]))
        return QUALITY_MAX;
    int64_t cycles = load(&words[STATION_CYCLE])
                     - load(&words[first + RX_RECEIVED + ARRIVED_IN_CYCLE]);
    if (cycles > MAX_NS / self->cycle_ns)
        return QUALITY_MAX;
    int64_t age_ns = (cycles > 0 ? cycles : 0) * self->cycle_ns
                     + load(&words[origin->word + RX_RESPONSE_NS]);
    const uint8_t *header = (uint8_t *)self->memory[0].buf + origin->header;
    return (header[PD_QUALITY] | header[PD_QUALITY + 1] << 8) + age_ns / QUALITY_NS;
}

static void patch_run(const Patch *self, int64_t cycle) {
    uint8_t *frame = self->frame.buf;
    frame[self->cycle_at] = (uint8_t)cycle;
    frame[self->cycle_at + 1] = (uint8_t)(cycle >> 8);
    const Move *end = self->moves + self->move_size / (Py_ssize_t)sizeof(Move);
    for (const Move *move = self->moves; move < end; move++) {
        const uint8_t *memory = self->memory[move->from].buf;
        if (is_whole(move))
            memmove(frame + (move->target >> 3), memory + (move->source >> 3),
                    (size_t)(move->bits >> 3));
        else
            move_bits(move, memory, frame);
    }
    const Origin *last = self->origins + self->origin_size / (Py_ssize_t)sizeof(Origin);
    int64_t oldest = 0;
    for (const Origin *origin = self->origins; origin < last; origin++) {
        int64_t age = quality_of(self, origin);
        if (age > oldest)
            oldest = age > QUALITY_MAX ? QUALITY_MAX : age;
        if (origin + 1 == last || origin[1].target != origin->target) {
            frame[origin->target] = (uint8_t)oldest;
            frame[origin->target + 1] = (uint8_t)(oldest >> 8);
            oldest = 0;
        }
    }
}

/* patch(cycle): write the counter, the data and the qualities of all PDs. */
static PyObject *patch_call(Patch *self, PyObject *args, PyObject *keywords) {
    long long cycle;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "L", &cycle))
        return NULL;
    patch_run(self, cycle);
    Py_RETURN_NONE;
}

static PyType_Slot patch_slots[] = {
    {Py_tp_new, patch_new}, {Py_tp_dealloc, patch_dealloc}, {Py_tp_call, patch_call}, {0, NULL},
};
PyType_Spec patch_spec = {
    "eap._cyclic.Patch", sizeof(Patch), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    patch_slots,
};

/* ---- SendPlan: the frames of a port that go by their schedule alone ---- */

/* A frame is due in each cycle that leaves *phase* divided by *step*; two words count it. */
typedef struct {
    int64_t step, phase, whole, sent_at;
} Row;

typedef struct {
    PyObject_HEAD
    Py_buffer words;
    Py_ssize_t count;  /* -1: Python has to select frames */
    PyObject *frames, *patches;
    Row *rows;
    struct mmsghdr *headers, *due;
    struct iovec *vectors;
    PyObject *addresses, *socket;  /* that the headers were completed for */
} SendPlan;

static void plan_free(SendPlan *self) {
    self->count = -1;
    Py_CLEAR(self->frames);
    Py_CLEAR(self->patches);
    Py_CLEAR(self->addresses);
    Py_CLEAR(self->socket);
    PyMem_Free(self->rows);
    PyMem_Free(self->headers);
    PyMem_Free(self->due);
    PyMem_Free(self->vectors);
    self->rows = NULL;
    self->headers = self->due = NULL;
    self->vectors = NULL;
}

static void plan_dealloc(SendPlan *self) {
    plan_free(self);
    release_buffer(&self->words);
    free_object((PyObject *)self);
}

/* SendPlan(words): of the image. */
static PyObject *plan_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *words;
    if (!PyArg_ParseTuple(args, "O", &words))
        return NULL;
    SendPlan *self = (SendPlan *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    self->count = -1;
    if (PyObject_GetBuffer(words, &self->words, PyBUF_CONTIG))
        Py_CLEAR(self);
    return (PyObject *)self;
}

static int plan_check(SendPlan *self, Py_ssize_t row_size) {
    const Py_ssize_t count = PyList_Size(self->frames);
    if (PyList_Size(self->patches) != count || (uintptr_t)self->words.buf % WORD
        || row_size != count * (Py_ssize_t)sizeof(Row))
        return refuse("a plan has a patch and a row for each frame");
    self->headers = PyMem_Calloc((size_t)count + 1, sizeof *self->headers);
    self->due = PyMem_Calloc((size_t)count + 1, sizeof *self->due);
    self->vectors = PyMem_Calloc((size_t)count + 1, sizeof *self->vectors);
    if (self->headers == NULL || self->due == NULL || self->vectors == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t n = 0; n < count; n++) {
        const Row *row = &self->rows[n];
        const Patch *patch = (Patch *)PyList_GetItem(self->patches, n);
        if (!Py_IS_TYPE((PyObject *)patch, patch_type) || row->step < 1
            || !is_within(row->whole, 1, self->words.len / WORD)
            || !is_within(row->sent_at, 1, self->words.len / WORD))
            return refuse("a frame of a plan is none, or reaches outside of the image");
        self->vectors[n].iov_base = patch->frame.buf;
        self->vectors[n].iov_len = (size_t)patch->frame.len;
        self->headers[n].msg_hdr.msg_iov = &self->vectors[n];
        self->headers[n].msg_hdr.msg_iovlen = 1;
    }
    self->count = count;
    return 0;
}

/* fill(frames, patches, rows): of all frames of the port. */
static PyObject *plan_fill(SendPlan *self, PyObject *args) {
    PyObject *frames, *patches;
    const char *rows;
    Py_ssize_t row_size;
    if (!PyArg_ParseTuple(args, "OOy#", &frames, &patches, &rows, &row_size))
        return NULL;
    plan_free(self);
    if ((self->frames = PySequence_List(frames)) != NULL
        && (self->patches = PySequence_List(patches)) != NULL
        && (self->rows = copy_of(rows, row_size)) != NULL && !plan_check(self, row_size))
        Py_RETURN_NONE;
    plan_free(self);
    return NULL;
}

/* clear(): leave all frames to Python. */
static PyObject *plan_clear(SendPlan *self, PyObject *nothing) {
    (void)nothing;
    plan_free(self);
    Py_RETURN_NONE;
}

/* Complete the headers with the addresses of all frames. */
static int address(SendPlan *self, Socket *socket) {
    PyObject *addresses = PyList_New(self->count);
    if (addresses == NULL)
        return -1;
    Py_CLEAR(self->socket);
    for (Py_ssize_t n = 0; n < self->count; n++) {
        PyObject *found = PyObject_CallMethod(socket->sender, "address_of", "O",
                                              PyList_GetItem(self->frames, n));
        if (found == NULL || PyList_SetItem(addresses, n, found))
            goto failed;
        if (!PyBytes_Check(found)) {
            refuse("an address is packed into bytes");
            goto failed;
        }
        Py_ssize_t size = PyBytes_Size(found);
        self->headers[n].msg_hdr.msg_name = size ? PyBytes_AsString(found) : NULL;
        self->headers[n].msg_hdr.msg_namelen = (socklen_t)size;
    }
    Py_XDECREF(self->addresses);
    self->addresses = addresses;
    Py_INCREF((PyObject *)socket);
    self->socket = (PyObject *)socket;
    return 0;
failed:
    Py_DECREF(addresses);
    return -1;
}

static int is_due(const Row *row, int64_t cycle) { return cycle % row->step == row->phase; }

/* Hand the *count* due frames to the kernel; return how many it took, or -1. */
static int transmit(SendPlan *self, int fd, Py_ssize_t count, int64_t cycle) {
    struct mmsghdr *headers = self->headers;
    if (count < self->count) {
        headers = self->due;
        for (Py_ssize_t n = 0, to = 0; n < self->count; n++)
            if (is_due(&self->rows[n], cycle))
                headers[to++] = self->headers[n];
    }
    if (count > 1)
        return sendmmsg(fd, headers, (unsigned)count, MSG_DONTWAIT);
    const struct msghdr *only = &headers->msg_hdr;
    return sendto(fd, only->msg_iov->iov_base, only->msg_iov->iov_len, MSG_DONTWAIT,
                  only->msg_name, only->msg_namelen) < 0 ? -1 : 1;
}

/* Return the due frames as a list. */
static PyObject *due_frames(const SendPlan *self, int64_t cycle) {
    PyObject *frames = PyList_New(0);
    for (Py_ssize_t n = 0; frames != NULL && n < self->count; n++)
        if (is_due(&self->rows[n], cycle)
            && PyList_Append(frames, PyList_GetItem(self->frames, n)))
            Py_CLEAR(frames);
    return frames;
}

/* Send the due frames, which are patched; return those that were not sent, NULL for an error. */
static PyObject *send_frames(SendPlan *self, const Outlet *outlet, Py_ssize_t count,
                             const Moment *moment) {
    Socket *socket = (Socket *)outlet->socket;
    PyObject *frames, *failed;
    int sent = 0, number = 0;
    const int is_direct = Py_IS_TYPE(outlet->socket, socket_type) && socket->may_send;
    if (is_direct) {
        if (self->socket != outlet->socket && address(self, socket))
            return NULL;
        sent = transmit(self, socket->fd, count, moment->number);
        number = errno;
        if (sent == count) {
            Py_INCREF(Py_None);
            return Py_None;
        }
    }
    if ((frames = due_frames(self, moment->number)) == NULL)
        return NULL;
    if (is_direct)
        failed = PyObject_CallMethod(socket->sender, "go_on", "Oii", frames, sent, number);
    else
        failed = PyObject_CallMethod(outlet->channel, "send", "OO", frames, moment->now);
    Py_DECREF(frames);
    return failed;
}

Result send_due(const Outlet *outlet, const Moment *moment) {
    SendPlan *self = (SendPlan *)outlet->plan;
    if (!Py_IS_TYPE(outlet->plan, send_plan_type) || self->count < 0)
        return LEFT_TO_PYTHON;
    Py_ssize_t count = 0;
    for (Py_ssize_t n = 0; n < self->count; n++)
        if (is_due(&self->rows[n], moment->number)) {
            patch_run((Patch *)PyList_GetItem(self->patches, n), moment->number);
            count++;
        }
    if (!count)
        return TAKEN;
    PyObject *failed = send_frames(self, outlet, count, moment);
    int any = failed == NULL ? -1 : failed == Py_None ? 0 : PyObject_IsTrue(failed);
    if (any > 0) {
        PyObject *done = PyObject_CallMethod(outlet->publisher, "sent_partly", "LOO",
                                             (long long)moment->number, failed, moment->now);
        any = done == NULL ? -1 : 1;
        Py_XDECREF(done);
    }
    Py_XDECREF(failed);
    int64_t *words = self->words.buf;
    for (Py_ssize_t n = 0; !any && n < self->count; n++)
        if (is_due(&self->rows[n], moment->number)) {
            add(&words[self->rows[n].whole], 1);
            store(&words[self->rows[n].sent_at], moment->now_ns);
        }
    return any < 0 ? FAILED : TAKEN;
}

static PyMethodDef plan_methods[] = {
    {"fill", (PyCFunction)plan_fill, METH_VARARGS, NULL},
    {"clear", (PyCFunction)plan_clear, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};
static PyType_Slot plan_slots[] = {
    {Py_tp_new, plan_new}, {Py_tp_dealloc, plan_dealloc}, {Py_tp_methods, plan_methods}, {0, NULL},
};
PyType_Spec send_plan_spec = {
    "eap._cyclic.SendPlan", sizeof(SendPlan), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    plan_slots,
};
