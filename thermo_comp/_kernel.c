/* SPDX-FileCopyrightText: 2026 thermo_comp contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Owns the compiled form of `kernel.correct`: its operations on doubles, in its order, so that the
 * bits are the same; but in one pass, because what a sample costs there is its way to memory.
 *
 * Two things keep the bits: no contraction to fused operations (see setup.py), and double
 * arithmetic without excess precision.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if FLT_EVAL_METHOD != 0
#error "doubles are computed with excess precision here: the bits would not be those of numpy"
#endif

enum { N_COLUMNS = 21, N_OUT = 12, LANES = 4, CHUNK = 256 };

/* Samples on their way: they stay in the first cache. */
struct chunk {
    double dt[CHUNK];
    double raw[3][CHUNK];
    double value[3][CHUNK];
};

/* The coefficients of one axis over one segment. */
struct line {
    double bias, bias_slope, scale, scale_slope, a, b, c;
};

/* That of all axes, always. */
struct misalignment {
    double yx, zx, zy, var_yx, var_zx, var_zy;
};

/* Widen the extremes by some values; NaN where one is, as np.minimum has it. */
static void
widen(const double *values, Py_ssize_t n, double *lowest, double *highest)
{
    double low[LANES], high[LANES], odd[LANES];
    Py_ssize_t i = 0;
    int j;

    for (j = 0; j < LANES; j++) {
        low[j] = *lowest;
        high[j] = *highest;
        odd[j] = 0.0;
    }
    for (; i + LANES <= n; i += LANES) {
        for (j = 0; j < LANES; j++) {
            const double value = values[i + j];

            low[j] = value < low[j] ? value : low[j];
            high[j] = value > high[j] ? value : high[j];
            odd[j] += value - value;
        }
    }
    for (; i < n; i++) {
        low[0] = values[i] < low[0] ? values[i] : low[0];
        high[0] = values[i] > high[0] ? values[i] : high[0];
        odd[0] += values[i] - values[i];
    }
    for (j = 0; j < LANES; j++) {
        *lowest = low[j] < *lowest ? low[j] : *lowest;
        *highest = high[j] > *highest ? high[j] : *highest;
    }
    /* What is not finite, less itself, is NaN: only then is it worth a look which it is. */
    for (j = 0; j < LANES; j++) {
        if (odd[j] != 0.0) {
            for (i = 0; i < n; i++) {
                if (isnan(values[i])) {
                    *lowest = *highest = values[i];
                }
            }
            return;
        }
    }
}

/* Take bias and scale from the samples of one axis. */
static void
take(const struct line *line, const double *restrict dt, const double *restrict raw, Py_ssize_t n,
     double *restrict value)
{
    const double bias = line->bias, bias_slope = line->bias_slope;
    const double scale = line->scale, scale_slope = line->scale_slope;
    Py_ssize_t i;

    for (i = 0; i < n; i++) {
        value[i] = (raw[i] - (bias_slope * dt[i] + bias)) / (scale_slope * dt[i] + scale);
    }
}

/* Turn what the axes measure into force and covariance, whose columns are `stride` apart. */
static void
turn(const struct line *lines, const struct misalignment *m, const struct chunk *chunk,
     Py_ssize_t n, Py_ssize_t stride, double *restrict out)
{
    const double ax = lines[0].a, bx = lines[0].b, cx = lines[0].c;
    const double ay = lines[1].a, by = lines[1].b, cy = lines[1].c;
    const double az = lines[2].a, bz = lines[2].b, cz = lines[2].c;
    const double yx = m->yx, zx = m->zx, zy = m->zy, zy_zy = zy * zy;
    const double var_yx = m->var_yx, var_zx = m->var_zx, var_zy = m->var_zy;
    double *restrict force_x = out, *restrict force_y = out + stride;
    double *restrict force_z = out + 2 * stride;
    double *restrict xx_ = out + 3 * stride, *restrict xy_ = out + 4 * stride;
    double *restrict xz_ = out + 5 * stride, *restrict yx_ = out + 6 * stride;
    double *restrict yy_ = out + 7 * stride, *restrict yz_ = out + 8 * stride;
    double *restrict zx_ = out + 9 * stride, *restrict zy_ = out + 10 * stride;
    double *restrict zz_ = out + 11 * stride;
    Py_ssize_t i;

    for (i = 0; i < n; i++) {
        const double x = chunk->value[0][i], y = chunk->value[1][i], z = chunk->value[2][i];
        const double vx = (cx * x + bx) * x + ax;
        const double vy = (cy * y + by) * y + ay;
        const double vz = (cz * z + bz) * z + az;
        const double cxy = vx * yx, cxz = vx * zx;
        const double cyz = cxz * yx + vy * zy;
        const double xx = x * x, yy = y * y;

        force_x[i] = x;
        force_y[i] = x * yx + y;
        force_z[i] = (zx * x + y * zy) + z;
        xx_[i] = vx;
        xy_[i] = yx_[i] = cxy;
        xz_[i] = zx_[i] = cxz;
        yy_[i] = (cxy * yx + vy) + xx * var_yx;
        yz_[i] = zy_[i] = cyz;
        zz_[i] = (((cxz * zx + vy * zy_zy) + vz) + xx * var_zx) + yy * var_zy;
    }
}

/* Where things stand; strides in bytes, because samples lie between other fields of a record. */
struct job {
    const char *starts, *counts, *columns, *stamps, *samples;
    Py_ssize_t start_step, count_step, column_steps[2], stamp_step, sample_steps[2];
    Py_ssize_t n_segments, n;
    double *out;
};

static double
real(const char *place)
{
    double value;

    memcpy(&value, place, sizeof value);
    return value;
}

static int64_t
integer(const char *place)
{
    int64_t value;

    memcpy(&value, place, sizeof value);
    return value;
}

static void
gather(const struct job *job, Py_ssize_t first, Py_ssize_t n, int64_t start_ns,
       struct chunk *chunk)
{
    const char *stamp = job->stamps + first * job->stamp_step;
    const char *sample = job->samples + first * job->sample_steps[0];
    const Py_ssize_t axis = job->sample_steps[1];
    Py_ssize_t i;

    for (i = 0; i < n; i++) {
        /* Unsigned, so that a difference beyond 64 bits wraps as numpy's does. */
        const uint64_t age_ns = (uint64_t)integer(stamp) - (uint64_t)start_ns;

        chunk->dt[i] = (double)(int64_t)age_ns * 1e-9;
        chunk->raw[0][i] = real(sample);
        chunk->raw[1][i] = real(sample + axis);
        chunk->raw[2][i] = real(sample + 2 * axis);
        stamp += job->stamp_step;
        sample += job->sample_steps[0];
    }
}

static void
run(const struct job *job, const struct misalignment *m, double *lowest, double *highest)
{
    struct chunk chunk;
    struct line lines[3];
    double column[N_COLUMNS];
    Py_ssize_t segment, first = 0;
    int axis, k;

    for (segment = 0; segment < job->n_segments; segment++) {
        const int64_t start_ns = integer(job->starts + segment * job->start_step);
        const int64_t count = integer(job->counts + segment * job->count_step);
        /* They have been checked; but without the lock another thread may write to them. */
        const Py_ssize_t after = count < job->n - first ? first + count : job->n;

        for (k = 0; k < N_COLUMNS; k++) {
            column[k] = real(job->columns + k * job->column_steps[0]
                             + segment * job->column_steps[1]);
        }
        for (axis = 0; axis < 3; axis++) {
            const double *shift = column + 4 * axis, *variance = column + 12 + 3 * axis;
            const struct line line = {shift[0], shift[1], shift[2], shift[3],
                                      variance[0], variance[1], variance[2]};

            lines[axis] = line;
        }
        while (first < after) {
            const Py_ssize_t n = after - first < CHUNK ? after - first : CHUNK;

            gather(job, first, n, start_ns, &chunk);
            for (axis = 0; axis < 3; axis++) {
                widen(chunk.raw[axis], n, lowest + axis, highest + axis);
                take(lines + axis, chunk.dt, chunk.raw[axis], n, chunk.value[axis]);
            }
            turn(lines, m, &chunk, n, job->n, job->out + first);
            first += n;
        }
    }
}

/* Take a buffer of doubles or of 64-bit integers in the machine's order; 0 on success. */
static int
open_buffer(PyObject *object, const char *name, const char *codes, int n_dimensions, int flags,
            Py_buffer *view)
{
    const char *format;

    if (PyObject_GetBuffer(object, view, flags | PyBUF_FORMAT) != 0) {
        return -1;
    }
    /* These say nothing but that the order is the machine's; '^' is numpy's, for unaligned. */
    format = view->format == NULL ? "B" : view->format;
    format += *format != '\0' && strchr(PY_LITTLE_ENDIAN ? "@=^<" : "@=^>!", *format) != NULL;
    if (*format == '\0' || format[1] != '\0' || strchr(codes, *format) == NULL
        || view->itemsize != 8) {
        PyErr_Format(PyExc_TypeError, "%s must hold %s of 64 bits in the machine's order", name,
                     *codes == 'd' ? "floats" : "integers");
    }
    else if (view->ndim != n_dimensions) {
        PyErr_Format(PyExc_ValueError, "%s must have %d dimension(s), got %d", name, n_dimensions,
                     view->ndim);
    }
    else {
        return 0;
    }
    PyBuffer_Release(view);
    return -1;
}

static int
check_shape(const char *name, const Py_buffer *view, Py_ssize_t rows, Py_ssize_t columns)
{
    if (view->shape[0] == rows && (view->ndim == 1 || view->shape[1] == columns)) {
        return 0;
    }
    PyErr_Format(PyExc_ValueError, "%s does not have the shape that goes with the others", name);
    return -1;
}

/* The segments must cover the samples and no more: nothing is read or written beyond. */
static int
check_counts(const struct job *job)
{
    Py_ssize_t left = job->n, segment;

    for (segment = 0; segment < job->n_segments; segment++) {
        const int64_t count = integer(job->counts + segment * job->count_step);

        if (count < 0 || count > left) {
            left = -1;
            break;
        }
        left -= (Py_ssize_t)count;
    }
    if (left == 0) {
        return 0;
    }
    PyErr_SetString(PyExc_ValueError, "counts must not be negative and sum up to the samples");
    return -1;
}

enum { STARTS, COUNTS, COLUMNS, STAMPS, SAMPLES, OUT, N_VIEWS };

PyDoc_STRVAR(correct_doc,
"correct(start_ns, counts, columns, stamps, samples, out, misalignment)\n"
"--\n\n"
"Correct the samples that stand in segments; see `kernel.correct`.\n\n"
"`columns` has a row per coefficient, `out` one per component of force and covariance.\n"
"Returns the lowest and the highest sample of each axis.");

static PyObject *
correct(PyObject *Py_UNUSED(module), PyObject *args)
{
    static const struct {
        const char *name, *codes;
        int n_dimensions, flags;
    } wanted[N_VIEWS] = {
        {"start_ns", "lq", 1, PyBUF_STRIDES},
        {"counts", "lq", 1, PyBUF_STRIDES},
        {"columns", "d", 2, PyBUF_STRIDES},
        {"stamps", "lq", 1, PyBUF_STRIDES},
        {"samples", "d", 2, PyBUF_STRIDES},
        {"out", "d", 2, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE},
    };
    PyObject *objects[N_VIEWS], *result = NULL;
    Py_buffer views[N_VIEWS];
    struct misalignment m;
    struct job job;
    double lowest[3] = {INFINITY, INFINITY, INFINITY};
    double highest[3] = {-INFINITY, -INFINITY, -INFINITY};
    int n_open = 0;

    if (!PyArg_ParseTuple(args, "OOOOOO(dddddd):correct", &objects[STARTS], &objects[COUNTS],
                          &objects[COLUMNS], &objects[STAMPS], &objects[SAMPLES], &objects[OUT],
                          &m.yx, &m.zx, &m.zy, &m.var_yx, &m.var_zx, &m.var_zy)) {
        return NULL;
    }
    for (; n_open < N_VIEWS; n_open++) {
        if (open_buffer(objects[n_open], wanted[n_open].name, wanted[n_open].codes,
                        wanted[n_open].n_dimensions, wanted[n_open].flags, &views[n_open]) != 0) {
            goto done;
        }
    }
    job.n_segments = views[STARTS].shape[0];
    job.n = views[STAMPS].shape[0];
    if (check_shape("counts", &views[COUNTS], job.n_segments, 0) != 0
        || check_shape("columns", &views[COLUMNS], N_COLUMNS, job.n_segments) != 0
        || check_shape("samples", &views[SAMPLES], job.n, 3) != 0
        || check_shape("out", &views[OUT], N_OUT, job.n) != 0) {
        goto done;
    }
    job.starts = views[STARTS].buf;
    job.start_step = views[STARTS].strides[0];
    job.counts = views[COUNTS].buf;
    job.count_step = views[COUNTS].strides[0];
    job.columns = views[COLUMNS].buf;
    memcpy(job.column_steps, views[COLUMNS].strides, sizeof job.column_steps);
    job.stamps = views[STAMPS].buf;
    job.stamp_step = views[STAMPS].strides[0];
    job.samples = views[SAMPLES].buf;
    memcpy(job.sample_steps, views[SAMPLES].strides, sizeof job.sample_steps);
    job.out = views[OUT].buf;
    if (check_counts(&job) != 0) {
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS
    run(&job, &m, lowest, highest);
    Py_END_ALLOW_THREADS
    result = Py_BuildValue("(ddd)(ddd)", lowest[0], lowest[1], lowest[2], highest[0], highest[1],
                           highest[2]);
done:
    while (n_open > 0) {
        PyBuffer_Release(&views[--n_open]);
    }
    return result;
}

static PyMethodDef methods[] = {
    {"correct", correct, METH_VARARGS, correct_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "thermo_comp._kernel", NULL, 0, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC
PyInit__kernel(void)
{
    return PyModule_Create(&definition);
}
