/* Copies of bytes and bits from one memory to another, as CopyPlan of eap/pd/copyplan.py. */

#include "cyclic.h"

typedef struct {
    int64_t source, target, size;
} Slice;

/* One byte through a table, which shifts and masks it; bits of *keep* stay. */
typedef struct {
    int64_t source, target, keep;
    uint8_t table[256];
} BitCopy;

/* Whole bytes of the target whose bits begin at *shift* in the first one of the source. */
typedef struct {
    int64_t source, target, size, shift;
} ShiftedCopy;

typedef struct {
    PyObject_HEAD
    Slice *slices;
    BitCopy *bits;
    ShiftedCopy *shifted;
    Py_ssize_t slice_size, bit_size, shifted_size;
    int64_t source_needed, target_needed;
} Copies;

static void copies_dealloc(Copies *self) {
    PyMem_Free(self->slices);
    PyMem_Free(self->bits);
    PyMem_Free(self->shifted);
    free_object((PyObject *)self);
}

static int copies_check(Copies *self) {
    int64_t *source = &self->source_needed, *target = &self->target_needed;
    for (Py_ssize_t n = 0; n < self->slice_size / (Py_ssize_t)sizeof(Slice); n++) {
        const Slice *each = &self->slices[n];
        if (need(source, each->source, each->size) || need(target, each->target, each->size))
            return -1;
    }
    for (Py_ssize_t n = 0; n < self->bit_size / (Py_ssize_t)sizeof(BitCopy); n++)
        if (need(source, self->bits[n].source, 1) || need(target, self->bits[n].target, 1))
            return -1;
    for (Py_ssize_t n = 0; n < self->shifted_size / (Py_ssize_t)sizeof(ShiftedCopy); n++) {
        const ShiftedCopy *each = &self->shifted[n];
        if (each->shift < 1 || each->shift > 7)
            return refuse("a shifted copy begins within a byte");
        if (need(target, each->target, each->size) || need(source, each->source, each->size + 1))
            return -1;
    }
    return 0;
}

/* Copies(slices, bits, shifted): rows of Slice, BitCopy and ShiftedCopy. */
static PyObject *copies_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    const char *slices, *bits, *shifted;
    Copies *self = (Copies *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    if (!PyArg_ParseTuple(args, "y#y#y#", &slices, &self->slice_size, &bits, &self->bit_size,
                          &shifted, &self->shifted_size))
        goto failed;
    if (self->slice_size % (Py_ssize_t)sizeof(Slice) || self->bit_size % (Py_ssize_t)sizeof(BitCopy)
        || self->shifted_size % (Py_ssize_t)sizeof(ShiftedCopy)) {
        refuse("the copies are cut off");
        goto failed;
    }
    if ((self->slices = copy_of(slices, self->slice_size)) != NULL
        && (self->bits = copy_of(bits, self->bit_size)) != NULL
        && (self->shifted = copy_of(shifted, self->shifted_size)) != NULL && !copies_check(self))
        return (PyObject *)self;
failed:
    Py_DECREF(self);
    return NULL;
}

/* Both may be the same memory: of a copy onto itself nothing is written before it is read. */
static void copy_shifted(const ShiftedCopy *each, const uint8_t *from, uint8_t *to) {
    int shift = (int)each->shift;
    for (int64_t n = 0; n < each->size; n++) {
        int64_t at = (uintptr_t)to > (uintptr_t)from ? each->size - 1 - n : n;
        to[at] = (uint8_t)(from[at] >> shift | from[at + 1] << (8 - shift));
    }
}

/* run(source, target): copy everything. */
static PyObject *copies_run(Copies *self, PyObject *args) {
    Py_buffer source, target;
    if (!PyArg_ParseTuple(args, "y*w*", &source, &target))
        return NULL;
    const uint8_t *from = source.buf;
    uint8_t *to = target.buf;
    int fits = self->source_needed <= source.len && self->target_needed <= target.len;
    for (Py_ssize_t n = 0; fits && n < self->slice_size / (Py_ssize_t)sizeof(Slice); n++) {
        const Slice *each = &self->slices[n];
        memmove(to + each->target, from + each->source, (size_t)each->size);
    }
    for (Py_ssize_t n = 0; fits && n < self->bit_size / (Py_ssize_t)sizeof(BitCopy); n++) {
        const BitCopy *each = &self->bits[n];
        uint8_t *octet = to + each->target;
        *octet = (uint8_t)((*octet & each->keep) | each->table[from[each->source]]);
    }
    for (Py_ssize_t n = 0; fits && n < self->shifted_size / (Py_ssize_t)sizeof(ShiftedCopy); n++) {
        const ShiftedCopy *each = &self->shifted[n];
        copy_shifted(each, from + each->source, to + each->target);
    }
    PyBuffer_Release(&source);
    PyBuffer_Release(&target);
    if (!fits)
        return PyErr_Format(PyExc_ValueError, "a copy reaches outside of its memory");
    Py_RETURN_NONE;
}

static PyMethodDef copies_methods[] = {
    {"run", (PyCFunction)copies_run, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};
static PyType_Slot copies_slots[] = {
    {Py_tp_new, copies_new}, {Py_tp_dealloc, copies_dealloc}, {Py_tp_methods, copies_methods},
    {0, NULL},
};
PyType_Spec copies_spec = {
    "eap._cyclic.Copies", sizeof(Copies), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    copies_slots,
};
