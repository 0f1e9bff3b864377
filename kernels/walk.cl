// SPDX-License-Identifier: BSD-3-Clause
// Random walks over the rows of R, which estimate x_i = sum over k >= 1 of c_k (R^k b)_i (eq. 22 to 26).
//
//   walk_rows      sums over the samples of a pixel: the walk starts there and reads b where it comes
//   walk_columns   the adjoint: the walk ends at a pixel and writes what it brings there, one record a sample;
//                  rows are those of R^T, and one more row, from which all walks start, is that of b
//
// A step goes from i to j with probability |R_ij| / |R_i| and multiplies the weight by sign(R_ij) |R_i|, so that
// the products of eq. 26 cancel. After step k the walk goes on with probability steps[k].y / 2^22; what it then
// is worth is weight * b_j * steps[k].x, where steps[k].x holds c_k over the probability to be scored there:
//   ENDPOINT     scored where it ends, the paper's eq. 26
//   COLLISION    scored at every step
// Rows without entries end a walk.
//
// A work-item takes WALKS chunks of CHUNK samples of one pixel, one walk of each at a time: their loads do not
// wait for each other. Samples of a chunk are summed in order, with the rounding errors of the sums kept
// (Knuth's two-sum). So the result does not depend on WALKS, nor on how chunks are spread over work-items.
// Arithmetic is + and * in this order, without contraction: the same bits on every device, as long as nothing
// falls below 2^-126, where devices round differently.
//
// Required defines: TABLE, see common/table.h; CHUNK; WALKS; K, the right-hand sides of one launch;
// ESTIMATOR: 0 ENDPOINT, 1 COLLISION (walk_columns: ENDPOINT).
// Counters of random numbers: pixel, sample, step / 2, stream; a step takes half a block.
// Layout: chunk c of a pixel holds samples first + c CHUNK up to `end`; `chunks` chunks a pixel. b is row-major
// with `stride` columns, of which offset .. offset + K - 1 are taken. Out of walk_rows: (units, K) of (sum, its
// rounding, sum of squares, its rounding).

#include "common/random.h"
#include "common/real.h"
#include "common/table.h"

#pragma OPENCL FP_CONTRACT OFF

#ifndef CHUNK
#error "walk.cl needs -DCHUNK=<samples that are summed on the device>"
#endif
#ifndef WALKS
#error "walk.cl needs -DWALKS=<walks of an item at a time>"
#endif
#ifndef K
#error "walk.cl needs -DK=<right-hand sides of one launch>"
#endif
#ifndef ESTIMATOR
#error "walk.cl needs -DESTIMATOR=<0 end-point, 1 collision>"
#endif
#define ENDPOINT 0
#define COLLISION 1

#define GO_ON_BITS 22
#define SLOT_BITS 42  // the rest of 64

// Where an item has several walks, what one will load is asked for while the others are at work: a fifth to a
// quarter less time a step. The language's own prefetch() does nothing in PoCL.
#if defined(__clang__) && WALKS > 1
#define FETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define FETCH(p)
#endif

#if TABLE == TABLE_CDF
// The first entry whose cumulative sum is above a uniform part of the total.
inline ulong draw_entry(global const ulong *entries, uint n, ulong word)
{
    const ulong part = mul_hi(word & ~(((ulong)1 << GO_ON_BITS) - 1), entries[n - 1] >> TARGET_BITS);
    uint low = 0, high = n - 1;
    while (low < high) {
        const uint half_way = low + (high - low) / 2;
        if (entries[half_way] >> TARGET_BITS <= part)
            low = half_way + 1;
        else
            high = half_way;
    }
    return entries[low];
}
#endif

inline ulong first_entry(uint4 record)
{
    return (ulong)record.y << 32 | record.x;
}

// A uniform choice of the entries of a row, by the upper bits of a word.
inline ulong slot(uint4 record, ulong word)
{
    return (word >> GO_ON_BITS) * record.z >> SLOT_BITS;
}

// One entry of the row with this record: its column and sign, and what the weight is multiplied by.
inline uint draw(uint4 record, global const ulong *entries, ulong word, real *factor)
{
    entries += first_entry(record);
#if TABLE == TABLE_ALIAS
    const ulong entry = entries[slot(record, word)], place = (word >> GO_ON_BITS) * record.z;
    const uint fraction = (uint)(place >> (SLOT_BITS - THRESHOLD_BITS)) & ((1u << THRESHOLD_BITS) - 1);
    const uint threshold = (uint)(entry >> (2 * TARGET_BITS));
    *factor = as_float(record.w);
    return (uint)(fraction < threshold ? entry >> TARGET_BITS : entry) & TARGET_MASK;
#elif TABLE == TABLE_CDF
    *factor = as_float(record.w);
    return record.z ? (uint)draw_entry(entries, record.z, word) & TARGET_MASK : 0;
#else
    const ulong entry = entries[slot(record, word)];
    *factor = (real)record.z * fabs(as_float((uint)(entry >> 32)));
    return ((uint)entry << 1) | (uint)(entry >> 63);
#endif
}

// sum + low += value
inline void two_sum(real value, real *sum, real *low)
{
    const real total = *sum + value;
    const real added = total - *sum;
    *low += (*sum - (total - added)) + (value - added);
    *sum = total;
}

// The walks of a work-item, side by side.
typedef struct {
    uint pixel[WALKS], start[WALKS], next[WALKS], stop[WALKS];  // samples start .. stop, `next` comes next
    uint row[WALKS], step[WALKS];
    int alive[WALKS];
    real weight[WALKS];
} walks;

inline void set_out(walks *walk, int units, int chunks, uint first, uint end, global const uint *pixels)
{
    for (int w = 0; w < WALKS; ++w) {
        const int unit = get_global_id(0) * WALKS + w;
        const int known = unit < units;
        walk->pixel[w] = known ? pixels[unit / chunks] : 0;
        walk->start[w] = walk->next[w] = first + (uint)(known ? unit % chunks : 0) * CHUNK;
        walk->stop[w] = known ? walk->start[w] + min(end - walk->start[w], (uint)CHUNK) : walk->start[w];
        walk->row[w] = walk->pixel[w];
        walk->step[w] = 0;
        walk->alive[w] = 0;
        walk->weight[w] = 0;
    }
}

// Start the next samples where walks have ended; 0 when there are none, and none under way.
inline int start_ended(walks *walk)
{
    int busy = 0;
    for (int w = 0; w < WALKS; ++w) {
        if (!walk->alive[w] && walk->next[w] < walk->stop[w]) {
            ++walk->next[w];
            walk->row[w] = walk->pixel[w];
            walk->step[w] = 0;
            walk->weight[w] = 1;
            walk->alive[w] = 1;
        }
        busy |= walk->alive[w];
    }
    return busy;
}

// The two words of 64 bits that the next two steps of each walk take.
inline void draw_words(const walks *walk, ulong seed, uint stream, ulong words[2][WALKS])
{
    for (int i = 0; i < WALKS; ++i) {
        uint x = walk->pixel[i], y = walk->next[i] - 1, z = walk->step[i] / 2, w = stream;
        philox(&x, &y, &z, &w, (uint)seed, (uint)(seed >> 32));
        words[0][i] = (ulong)y << 32 | x;
        words[1][i] = (ulong)w << 32 | z;
    }
}

// One step of every walk: `target` gets columns and signs, `factor` what weights are multiplied by, 0 where
// the row is empty. Walks that have ended take it too, from their start, and nobody looks. `b` may be 0.
inline void draw_targets(
    walks *walk, const ulong *words, global const uint4 *rows, global const ulong *entries, global const real *b,
    int stride, uint *target, real *factor)
{
    uint4 record[WALKS];
    for (int w = 0; w < WALKS; ++w) {
        record[w] = rows[walk->row[w]];
        FETCH(entries + first_entry(record[w]) + slot(record[w], words[w]));
    }
    for (int w = 0; w < WALKS; ++w) {
        target[w] = draw(record[w], entries, words[w], factor + w);
        FETCH(rows + (target[w] >> 1));
        if (b)
            FETCH(b + (int)(target[w] >> 1) * stride);
        factor[w] = record[w].z ? factor[w] : 0;
    }
}

inline void end_walk(walks *walk, int w)
{
    walk->alive[w] = 0;
    walk->row[w] = walk->pixel[w];
}

// Move walk w; returns whether it goes on after its score, and in `worth` what a score is multiplied by.
inline int move(walks *walk, int w, ulong word, uint target, real factor, global const uint2 *steps, real *worth)
{
    const uint2 step = steps[walk->step[w]++];
    walk->row[w] = target >> 1;
    walk->weight[w] *= target & 1 ? -factor : factor;
    *worth = walk->weight[w] * as_float(step.x);
    return ((uint)word & ((1u << GO_ON_BITS) - 1)) < step.y;
}

kernel void walk_rows(
    int units, int chunks, uint first, uint end, ulong seed, uint stream, int stride, int offset,
    global const uint *pixels, global const uint4 *rows, global const ulong *entries, global const uint2 *steps,
    global const real *b, global real4 *out)
{
    walks walk;
    real score[WALKS][K], sum[WALKS][K], low[WALKS][K], square[WALKS][K], square_low[WALKS][K];
    ulong words[2][WALKS];
    uint target[WALKS];
    real factor[WALKS];
    set_out(&walk, units, chunks, first, end, pixels);
    for (int w = 0; w < WALKS; ++w)
        for (int c = 0; c < K; ++c)
            score[w][c] = sum[w][c] = low[w][c] = square[w][c] = square_low[w][c] = 0;
    while (start_ended(&walk)) {
        draw_words(&walk, seed, stream, words);
        for (int part = 0; part < 2; ++part) {
            draw_targets(&walk, words[part], rows, entries, b, stride, target, factor);
            for (int w = 0; w < WALKS; ++w) {
                if (!walk.alive[w])
                    continue;
                int goes_on = 0;
                if (factor[w] != 0) {
                    real worth;
                    goes_on = move(&walk, w, words[part][w], target[w], factor[w], steps, &worth);
                    if (ESTIMATOR == COLLISION || !goes_on)
                        for (int c = 0; c < K; ++c)
                            score[w][c] += worth * b[(int)walk.row[w] * stride + offset + c];
                }
                if (goes_on)
                    continue;
                end_walk(&walk, w);
                for (int c = 0; c < K; ++c) {
                    two_sum(score[w][c], &sum[w][c], &low[w][c]);
                    two_sum(score[w][c] * score[w][c], &square[w][c], &square_low[w][c]);
                    score[w][c] = 0;
                }
            }
        }
    }
    for (int w = 0; w < WALKS; ++w) {
        const int unit = get_global_id(0) * WALKS + w;
        if (unit < units)
            for (int c = 0; c < K; ++c)
                out[unit * K + c] = (real4)(sum[w][c], low[w][c], square[w][c], square_low[w][c]);
    }
}

// Sample s writes ends[s - first] and scores[s - first]; `pixel` is the row of b behind those of R^T.
kernel void walk_columns(
    int units, uint first, uint end, ulong seed, uint stream, global const uint *pixel, global const uint4 *rows,
    global const ulong *entries, global const uint2 *steps, global uint *ends, global real *scores)
{
    walks walk;
    ulong words[2][WALKS];
    uint target[WALKS];
    real factor[WALKS];
    set_out(&walk, units, units, first, end, pixel);
    while (start_ended(&walk)) {
        draw_words(&walk, seed, stream, words);
        for (int part = 0; part < 2; ++part) {
            draw_targets(&walk, words[part], rows, entries, 0, 0, target, factor);
            for (int w = 0; w < WALKS; ++w) {
                if (!walk.alive[w])
                    continue;
                int goes_on = 0;
                real worth = 0;
                if (factor[w] != 0)
                    goes_on = move(&walk, w, words[part][w], target[w], factor[w], steps, &worth);
                if (goes_on)
                    continue;
                ends[walk.next[w] - 1 - first] = walk.row[w];
                scores[walk.next[w] - 1 - first] = worth;
                end_walk(&walk, w);
            }
        }
    }
}
