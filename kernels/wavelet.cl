// SPDX-License-Identifier: BSD-3-Clause
// Orthonormal wavelet transforms of pictures, periodized: from pixels to coefficients (split) and back (join).
//
// A level halves both sides: first along the rows (wavelet_split_rows), then along the columns
// (wavelet_split_columns); wavelet_join_columns and wavelet_join_rows undo it. wavelet_split_all and
// wavelet_join_all do the levels first .. last - 1 of small pictures at once: one work-group for each K
// right-hand sides, which waits for itself between passes.
//
// Work-items stride through pieces of K values (dimension 0), pairs of samples (1) and rows (2), as many as
// there are: a CPU takes one item a row or a pair, a GPU one a piece.
//
// Required defines: K, the neighbouring values that an item handles together: 1, 2, 3, 4 or 8;
// TAPS, the length of the filters, even.
// Layout: a picture is row-major, its k right-hand sides side by side. Coefficients stand as PyWavelets'
// coeffs_to_array puts them: of each side the approximation first, ceil(n / 2) of n. taps[2 * TAPS] is the
// low-pass filter, then the high-pass one, in the order of the samples. lines and near are scratch of as many
// pixels as the picture at the level, and as its approximation.
//
// A side of any length: `level` times halved it has n = ceil(pixels / 2^level) samples, the last of which may
// stand for fewer pixels than the others. It stays out of the filters; where an odd number of whole ones is
// left, the last two turn into one of the approximation and a detail, by a rotation that takes a constant to
// the approximation alone. Orthonormal, and a constant has one coefficient on any grid.

#include "common/pieces.h"

#ifndef TAPS
#error "wavelet.cl needs -DTAPS=<length of the filters: 2, 4, 6, ...>"
#endif

#define HALF (TAPS / 2)

// n samples make `pairs` of the approximation, `regular` of them by the filters. c and s turn
// the last two samples, where they are not a regular pair.
typedef struct {
    int n, pairs, regular;
    real c, s;
} side;

INLINE side side_at(int pixels, int level)
{
    const int size = 1 << level, whole = pixels >> level, rest = pixels & (size - 1);
    const int n = whole + (rest > 0);
    const real total = size + rest;
    side a = {n, (n + 1) / 2, whole / 2, sqrt(size / total), sqrt(rest / total)};
    return a;
}

// Of analysis: one sample of the approximation and one detail. Of synthesis: two neighbouring samples.
typedef struct {
    lanes first, second;
} pair;

// Approximation and detail number m of the samples x[0], x[step], ...; of an odd last one there is no detail.
INLINE pair split(side a, int m, global const real *x, int step, constant real *taps)
{
    pair p;
    p.first = p.second = 0;
    if (m >= a.regular) {
        const lanes last = LOAD(x + (a.n - 1) * step);
        p.first = last;
        if (a.n % 2 == 0) {
            const lanes before = LOAD(x + (a.n - 2) * step);
            p.first = a.c * before + a.s * last;
            p.second = a.s * before - a.c * last;
        }
        return p;
    }
    const int n = 2 * a.regular;
    int i = 2 * m + 1 - HALF;
    if (i >= 0 && i + TAPS <= n) {
        for (int t = 0; t < TAPS; ++t) {
            const lanes v = LOAD(x + (i + t) * step);
            p.first = taps[t] * v + p.first;
            p.second = taps[TAPS + t] * v + p.second;
        }
        return p;
    }
    while (i < 0)
        i += n;
    for (int t = 0; t < TAPS; ++t) {
        const lanes v = LOAD(x + i * step);
        p.first = taps[t] * v + p.first;
        p.second = taps[TAPS + t] * v + p.second;
        i = i + 1 == n ? 0 : i + 1;
    }
    return p;
}

// Where the two samples of join() stand. Pairs are cut so that both need the same coefficients.
INLINE int first_place(side a, int m)
{
    return m < a.regular ? 2 * m + (HALF + 1) % 2 : 2 * m;
}

INLINE int second_place(side a, int m)
{
    const int place = first_place(a, m) + 1;
    return m < a.regular && place == 2 * a.regular ? 0 : place;  // or a.n: there is none
}

// Two samples from approximations low[0], low[low_step], ... and details high[0], high[high_step], ...
INLINE pair join(
    side a, int m, global const real *low, int low_step, global const real *high, int high_step,
    constant real *taps)
{
    pair p;
    p.first = p.second = 0;
    if (m >= a.regular) {
        const lanes near = LOAD(low + m * low_step);
        p.first = near;
        if (a.n % 2 == 0) {
            const lanes detail = LOAD(high + m * high_step);
            p.first = a.c * near + a.s * detail;
            p.second = a.s * near - a.c * detail;
        }
        return p;
    }
    int i = m + HALF / 2 + 1 - HALF;
    while (i < 0)
        i += a.regular;
    while (i >= a.regular)
        i -= a.regular;
    for (int t = TAPS - 2; t >= 0; t -= 2) {
        const lanes near = LOAD(low + i * low_step), detail = LOAD(high + i * high_step);
        p.first = taps[t] * near + (taps[TAPS + t] * detail + p.first);
        p.second = taps[t + 1] * near + (taps[TAPS + t + 1] * detail + p.second);
        i = i + 1 == a.regular ? 0 : i + 1;
    }
    return p;
}

// Each row of x (rows, n, k) becomes a row of lines: approximation, then details.
kernel void wavelet_split_rows(
    int rows, int width, int level, int k, constant real *taps, global const real *x, global real *lines)
{
    const side a = side_at(width, level);
    for (int row = get_global_id(2); row < rows; row += get_global_size(2))
        for (int m = get_global_id(1); m < a.pairs; m += get_global_size(1))
            for (int p = get_global_id(0); p < pieces_of(k); p += get_global_size(0)) {
                const piece q = piece_of(p, k);
                const int i = row * a.n * k + q.at;
                const pair v = split(a, m, x + i, k, taps);
                put(lines, i + m * k, v.first, q.skip, 1, 0, x);
                if (a.pairs + m < a.n)
                    put(lines, i + (a.pairs + m) * k, v.second, q.skip, 1, 0, x);
            }
}

// Each column of lines (n, run): the approximation of the first `split_at` goes to near, whose rows are as long,
// where another level follows; all else to its place in out, whose rows are `pitch` long.
kernel void wavelet_split_columns(
    int height, int level, int run, int split_at, int pitch, real scale, int adds, constant real *taps,
    global const real *lines, global real *near, global const real *add, global real *out)
{
    const side a = side_at(height, level);
    const int pieces = pieces_of(split_at);
    const int all = pieces + pieces_of(run - split_at);
    for (int m = get_global_id(1); m < a.pairs; m += get_global_size(1))
        for (int p = get_global_id(0); p < all; p += get_global_size(0)) {
            const bool nearby = p < pieces;
            piece q = nearby ? piece_of(p, split_at) : piece_of(p - pieces, run - split_at);
            q.at += nearby ? 0 : split_at;
            const pair v = split(a, m, lines + q.at, run, taps);
            if (nearby)
                put(near, m * split_at + q.at, v.first, q.skip, 1, 0, lines);
            else
                put(out, m * pitch + q.at, v.first, q.skip, scale, adds, add);
            if (a.pairs + m < a.n)
                put(out, (a.pairs + m) * pitch + q.at, v.second, q.skip, scale, adds, add);
        }
}

// The columns of coefficients x, whose rows are `pitch` long, become those of lines (n, run); the approximation
// of the first `split_at` comes from near.
kernel void wavelet_join_columns(
    int height, int level, int run, int split_at, int pitch, constant real *taps, global const real *x,
    global const real *near, global real *lines)
{
    const side a = side_at(height, level);
    const int pieces = pieces_of(split_at);
    const int all = pieces + pieces_of(run - split_at);
    for (int m = get_global_id(1); m < a.pairs; m += get_global_size(1))
        for (int p = get_global_id(0); p < all; p += get_global_size(0)) {
            const bool nearby = p < pieces;
            piece q = nearby ? piece_of(p, split_at) : piece_of(p - pieces, run - split_at);
            q.at += nearby ? 0 : split_at;
            global const real *high = x + a.pairs * pitch + q.at;
            const pair v = join(
                a, m, (nearby ? near : x) + q.at, nearby ? split_at : pitch, high, pitch, taps);
            put(lines, first_place(a, m) * run + q.at, v.first, q.skip, 1, 0, lines);
            if (second_place(a, m) < a.n)
                put(lines, second_place(a, m) * run + q.at, v.second, q.skip, 1, 0, lines);
        }
}

// Each row of lines (rows, n, k), approximation and details, becomes a row of out.
kernel void wavelet_join_rows(
    int rows, int width, int level, int k, real scale, int adds, constant real *taps, global const real *lines,
    global const real *add, global real *out)
{
    const side a = side_at(width, level);
    for (int row = get_global_id(2); row < rows; row += get_global_size(2))
        for (int m = get_global_id(1); m < a.pairs; m += get_global_size(1))
            for (int p = get_global_id(0); p < pieces_of(k); p += get_global_size(0)) {
                const piece q = piece_of(p, k);
                const int i = row * a.n * k + q.at;
                const pair v = join(a, m, lines + i, k, lines + i + a.pairs * k, k, taps);
                put(out, i + first_place(a, m) * k, v.first, q.skip, scale, adds, add);
                if (second_place(a, m) < a.n)
                    put(out, i + second_place(a, m) * k, v.second, q.skip, scale, adds, add);
            }
}

// All levels first .. last - 1 of right-hand sides offset .. of x (n of `first`, k), a picture of height x width
// pixels at level 0. Group g does K of them.
kernel void wavelet_split_all(
    int height, int width, int first, int last, int k, int offset, real scale, int adds, constant real *taps,
    global const real *x, global real *lines, global real *near, global const real *add, global real *out)
{
    offset += K * get_group_id(2);
    for (int level = first; level < last; ++level) {
        const side a = side_at(height, level), b = side_at(width, level);
        for (int row = get_local_id(1); row < a.n; row += get_local_size(1))
            for (int m = get_local_id(0); m < b.pairs; m += get_local_size(0)) {
                const int i = row * b.n * k + offset;
                const pair v = split(b, m, x + i, k, taps);
                put(lines, i + m * k, v.first, 0, 1, 0, x);
                if (b.pairs + m < b.n)
                    put(lines, i + (b.pairs + m) * k, v.second, 0, 1, 0, x);
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
        for (int m = get_local_id(1); m < a.pairs; m += get_local_size(1))
            for (int j = get_local_id(0); j < b.n; j += get_local_size(0)) {
                const pair v = split(a, m, lines + j * k + offset, b.n * k, taps);
                if (j < b.pairs && level + 1 < last)
                    put(near, (m * b.pairs + j) * k + offset, v.first, 0, 1, 0, lines);
                else
                    put(out, (m * width + j) * k + offset, v.first, 0, scale, adds, add);
                if (a.pairs + m < a.n)
                    put(out, ((a.pairs + m) * width + j) * k + offset, v.second, 0, scale, adds, add);
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
        x = near;
    }
}

// The inverse: coefficients x become the picture `out` at level `first`; where this is not 0, the scale is 1 and
// nothing is added.
kernel void wavelet_join_all(
    int height, int width, int first, int last, int k, int offset, real scale, int adds, constant real *taps,
    global const real *x, global real *lines, global real *near, global const real *add, global real *out)
{
    offset += K * get_group_id(2);
    for (int level = last - 1; level >= first; --level) {
        const side a = side_at(height, level), b = side_at(width, level);
        for (int m = get_local_id(1); m < a.pairs; m += get_local_size(1))
            for (int j = get_local_id(0); j < b.n; j += get_local_size(0)) {
                const bool nearby = j < b.pairs && level + 1 < last;
                global const real *high = x + (a.pairs * width + j) * k + offset;
                const pair v = join(
                    a, m, (nearby ? near : x) + j * k + offset, (nearby ? b.pairs : width) * k, high, width * k,
                    taps);
                put(lines, (first_place(a, m) * b.n + j) * k + offset, v.first, 0, 1, 0, x);
                if (second_place(a, m) < a.n)
                    put(lines, (second_place(a, m) * b.n + j) * k + offset, v.second, 0, 1, 0, x);
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
        const bool done = level == first;
        for (int row = get_local_id(1); row < a.n; row += get_local_size(1))
            for (int m = get_local_id(0); m < b.pairs; m += get_local_size(0)) {
                const int i = row * b.n * k + offset;
                const pair v = join(b, m, lines + i, k, lines + i + b.pairs * k, k, taps);
                global real *to = done ? out : near;
                put(to, i + first_place(b, m) * k, v.first, 0, done ? scale : 1, done && adds, add);
                if (second_place(b, m) < b.n)
                    put(to, i + second_place(b, m) * k, v.second, 0, done ? scale : 1, done && adds, add);
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}
