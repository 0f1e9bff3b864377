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
// The R of several colour channels share a walk: it steps by a table of entries that any of them has, and the
// entry t of its row leads to links[t], a column and what the weight of each channel is multiplied by there.
//
// A work-item takes WALKS chunks of CHUNK samples of one pixel, one walk of each at a time: their loads do not
// wait for each other. Samples of a chunk are summed in order, with the rounding errors of the sums kept
// (Knuth's two-sum). So the result does not depend on WALKS, nor on how chunks are spread over work-items.
// Arithmetic is + and * in this order, without contraction: the same bits on every device, as long as nothing
// falls below 2^-126, where devices round differently.
//
// Required defines: TABLE, see common/table.h; CHUNK; WALKS; K, the right-hand sides of one launch;
// ESTIMATOR: 0 ENDPOINT, 1 COLLISION (walk_columns: ENDPOINT); CHANNELS: 1, or 3 with links (walk_rows only).
// Counters of random numbers: pixel, sample, step / 2, stream; a step takes half a block.
// Layout: chunk c of a pixel holds samples first + c CHUNK up to `end`; `chunks` chunks a pixel. b is row-major
// with `stride` columns, of which offset .. offset + K - 1 are taken, the first of channel 0, the next of channel
// 1 and so on. Out of walk_rows: (units, K) of (sum, its rounding, sum of squares, its rounding). Without links
// `links` is not read.

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
#ifndef CHANNELS
#error "walk.cl needs -DCHANNELS=<1, or 3 that share walks>"
#endif
#if K % CHANNELS
#error "walk.cl needs a K that CHANNELS divides"
#endif
#define ENDPOINT 0
#define COLLISION 1

#define GO_ON_BITS 22
#define SLOT_BITS 42  // the rest of 64

// Walks that set off together: what they load comes while those of the next group are at work.
#define GROUP (WALKS % 8 ? WALKS : 8)
#define LANES (WALKS % 4 ? 1 : 4)  // whose random numbers are made side by side

// Where an item has several walks, what one will load is asked for while the others are at work: a third
// less time a step. The language's own prefetch() does nothing in PoCL.
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
    real weight[CHANNELS][WALKS];
    ulong word[WALKS];  // of the step to come, with the record of its row, where it leads and by what factor
    uint4 record[WALKS];
    uint target[WALKS];
    real factor[CHANNELS][WALKS];
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
        for (int c = 0; c < CHANNELS; ++c)
            walk->weight[c][w] = 0;
    }
}

// The words of the next step of walks w .. w + LANES.
inline void draw_words(walks *walk, int w, ulong seed, uint stream)
{
#if LANES == 4
    const ulong4 step = convert_ulong4(vload4(0, walk->step + w));
    ulong4 x = convert_ulong4(vload4(0, walk->pixel + w)), y = convert_ulong4(vload4(0, walk->next + w) - 1);
    ulong4 z = step / 2, other = stream;
    philox4(&x, &y, &z, &other, (uint)seed, (uint)(seed >> 32));
    vstore4(select(y << 32 | x, other << 32 | z, step << 63), 0, walk->word + w);
#else
    uint x = walk->pixel[w], y = walk->next[w] - 1, z = walk->step[w] / 2, other = stream;
    philox(&x, &y, &z, &other, (uint)seed, (uint)(seed >> 32));
    walk->word[w] = walk->step[w] & 1 ? (ulong)other << 32 | z : (ulong)y << 32 | x;
#endif
}

// Prepare one step of the walks begin .. begin + GROUP: start the next samples where walks have ended, draw the words of
// the step and ask for the table entries that it will take. Returns whether any walk is under way. Walks that
// have ended take the step too, from their start, and nobody looks.
inline int set_off(
    walks *walk, int begin, ulong seed, uint stream, global const uint4 *rows, global const ulong *entries)
{
    int busy = 0;
    for (int w = begin; w < begin + GROUP; ++w) {
        const int starts = !walk->alive[w] && walk->next[w] < walk->stop[w];
        walk->next[w] += starts;
        walk->alive[w] |= starts;
        walk->step[w] = starts ? 0 : walk->step[w];
        for (int c = 0; c < CHANNELS; ++c)
            walk->weight[c][w] = starts ? 1 : walk->weight[c][w];
        busy |= walk->alive[w];
    }
    for (int w = begin; w < begin + GROUP; w += LANES)
        draw_words(walk, w, seed, stream);
    for (int w = begin; w < begin + GROUP; ++w) {
        walk->record[w] = rows[walk->row[w]];
        FETCH(entries + first_entry(walk->record[w]) + slot(walk->record[w], walk->word[w]));
    }
    return busy;
}

inline int set_off_all(
    walks *walk, ulong seed, uint stream, global const uint4 *rows, global const ulong *entries)
{
    int busy = 0;
    for (int begin = 0; begin < WALKS; begin += GROUP)
        busy |= set_off(walk, begin, seed, stream, rows, entries);
    return busy;
}

#if CHANNELS > 1
// Replace the entries that walks have drawn by what they are linked to.
inline void follow(walks *walk, global const uint4 *links)
{
    for (int w = 0; w < WALKS; ++w)
        FETCH(links + first_entry(walk->record[w]) + (walk->target[w] >> 1));
    for (int w = 0; w < WALKS; ++w) {
        const uint4 record = walk->record[w];
        const uint4 link = record.z ? links[first_entry(record) + (walk->target[w] >> 1)] : (uint4)(0);
        walk->target[w] = link.x << 1;
        walk->factor[0][w] = as_float(link.y);
        walk->factor[1][w] = as_float(link.z);
        walk->factor[2][w] = as_float(link.w);
    }
}
#endif

// The columns and signs that the walks step to, and what weights are multiplied by, 0 where the row is empty.
// `b` may be 0.
inline void draw_targets(
    walks *walk, global const uint4 *rows, global const ulong *entries, global const uint4 *links,
    global const real *b, int stride)
{
    for (int w = 0; w < WALKS; ++w) {
        walk->target[w] = draw(walk->record[w], entries, walk->word[w], walk->factor[0] + w);
        walk->factor[0][w] = walk->record[w].z ? walk->factor[0][w] : 0;
    }
#if CHANNELS > 1
    follow(walk, links);
#endif
    for (int w = 0; w < WALKS; ++w) {
        FETCH(rows + (walk->target[w] >> 1));
        if (b)
            FETCH(b + (int)(walk->target[w] >> 1) * stride);
    }
}

inline void end_walk(walks *walk, int w)
{
    walk->alive[w] = 0;
    walk->row[w] = walk->pixel[w];
}

// Move walk w; returns whether it goes on after its score, and in `worth` what a score of each channel is
// multiplied by: left as it is, 0, where the row is empty.
inline int move(walks *walk, int w, global const uint2 *steps, real *worth)
{
    int seen = 0;
    for (int c = 0; c < CHANNELS; ++c)
        seen |= walk->factor[c][w] != 0;
    if (!seen)
        return 0;
    const uint2 step = steps[walk->step[w]++];
    walk->row[w] = walk->target[w] >> 1;
    for (int c = 0; c < CHANNELS; ++c) {
        walk->weight[c][w] *= walk->target[w] & 1 ? -walk->factor[c][w] : walk->factor[c][w];
        worth[c] = walk->weight[c][w] * as_float(step.x);
    }
    return ((uint)walk->word[w] & ((1u << GO_ON_BITS) - 1)) < step.y;
}

kernel void walk_rows(
    int units, int chunks, uint first, uint end, ulong seed, uint stream, int stride, int offset,
    global const uint *pixels, global const uint4 *rows, global const ulong *entries, global const uint4 *links,
    global const uint2 *steps, global const real *b, global real4 *out)
{
    walks walk;
    real score[WALKS][K], sum[WALKS][K], low[WALKS][K], square[WALKS][K], square_low[WALKS][K];
    set_out(&walk, units, chunks, first, end, pixels);
    for (int w = 0; w < WALKS; ++w)
        for (int c = 0; c < K; ++c)
            score[w][c] = sum[w][c] = low[w][c] = square[w][c] = square_low[w][c] = 0;
    int busy = set_off_all(&walk, seed, stream, rows, entries);
    while (busy) {
        draw_targets(&walk, rows, entries, links, b, stride);
        busy = 0;
        for (int begin = 0; begin < WALKS; begin += GROUP) {
            for (int w = begin; w < begin + GROUP; ++w) {
                if (!walk.alive[w])
                    continue;
                real worth[CHANNELS] = {0};
                const int goes_on = move(&walk, w, steps, worth);
                if (ESTIMATOR == COLLISION || !goes_on)
                    for (int c = 0; c < K; ++c)
                        score[w][c] += worth[c % CHANNELS] * b[(int)walk.row[w] * stride + offset + c];
                if (goes_on)
                    continue;
                end_walk(&walk, w);
                for (int c = 0; c < K; ++c) {
                    two_sum(score[w][c], &sum[w][c], &low[w][c]);
                    two_sum(score[w][c] * score[w][c], &square[w][c], &square_low[w][c]);
                    score[w][c] = 0;
                }
            }
            busy |= set_off(&walk, begin, seed, stream, rows, entries);
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
    set_out(&walk, units, units, first, end, pixel);
    while (set_off_all(&walk, seed, stream, rows, entries)) {
        draw_targets(&walk, rows, entries, 0, 0, 0);
        for (int w = 0; w < WALKS; ++w) {
            if (!walk.alive[w])
                continue;
            real worth[CHANNELS] = {0};
            if (move(&walk, w, steps, worth))
                continue;
            ends[walk.next[w] - 1 - first] = walk.row[w];
            scores[walk.next[w] - 1 - first] = worth[0];
            end_walk(&walk, w);
        }
    }
}
