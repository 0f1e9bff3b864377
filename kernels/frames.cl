// SPDX-License-Identifier: BSD-3-Clause
// Frames of a prepared compensation, from the codes of a file to those of the projector:
//
//   frames_decode  light to add = gain * light of the codes - background
//   frames_clip    projector light within the bounds, as the unknowns of a solve
//   frames_encode  projector light within the bounds, as codes
//   frames_peaks   how much of the way to the upper bound each strip of pixels goes
//
// Codes are (pixels, colours), row-major. Light is one value a pixel and channel, at
// pixel * pixel_stride + channel * channel_stride: channels side by side, or one below the other.
// The projector light of channel c is
//
//   p_c = sum_d mixing[3 c + d] factors_d direct_d,
//
// and 0 where the factor of c is 0: at masked pixels.
//
// Required define: CODE, the type of codes: uchar, ushort or float. Of frames_decode TABLE, 1 if a
// table tells the light of each code, 0 if codes are light. Of frames_encode STEPS: 0 if codes are
// light; else codes are places in an ascending list of light, `thresholds`, STEPS of which lie
// within a cell at most; BETWEEN, 1 for places between two of them, as floats from 0 to 1.

#include "common/real.h"

#ifndef CODE
#error "frames.cl needs -DCODE=<type of codes: uchar, ushort or float>"
#endif
#ifndef TABLE
#define TABLE 0
#endif
#ifndef STEPS
#define STEPS 0
#endif
#ifndef BETWEEN
#define BETWEEN 0
#endif

#define AT(channel) (pixel * pixel_stride + (channel) * channel_stride)

// One work-item a pixel.
kernel void frames_decode(
    int pixels,                    // of a frame
    int colours,                   // of a code: 1, or as many as channels
    int channels,                  // of the light
    int pixel_stride,              // see above
    int channel_stride,            // see above
    real gain,                     // factor of the light
    real subtracts,                // 1: the background counts
    global const CODE *codes,      // (pixels, colours)
    global const real *table,      // light of each code; not read without TABLE
    global const real *background, // like out; not read where it does not count
    global real *out)              // light to add
{
    const int pixel = get_global_id(0);
    if (pixel >= pixels)
        return;
    for (int c = 0; c < channels; ++c) {
        const CODE code = codes[pixel * colours + min(c, colours - 1)];
#if TABLE
        const real light = table[code];
#else
        const real light = code;
#endif
        out[AT(c)] = gain * light - (subtracts != 0 ? background[AT(c)] : 0);
    }
}

// Projector light of one channel, without bounds; 0 at masked pixels.
INLINE real projector_light(
    int pixel, int channel, int channels, int pixel_stride, int channel_stride, int mixed,
    constant real *mixing, global const real *factors, global const real *direct)
{
    const real factor = factors[AT(channel)];
    if (!mixed || factor == 0)
        return factor * direct[AT(channel)];
    real light = 0;
    for (int d = 0; d < channels; ++d)
        light += mixing[channels * channel + d] * (factors[AT(d)] * direct[AT(d)]);
    return light;
}

#define LIGHT_ARGUMENTS \
    int pixels, int channels, int pixel_stride, int channel_stride, int mixed, real low, \
        real high, constant real *mixing, global const real *factors, global const real *direct
#define LIGHT(channel) \
    projector_light( \
        pixel, channel, channels, pixel_stride, channel_stride, mixed, mixing, factors, direct)

// One work-item a pixel. x = scale * clip(p); exceeded[0] is 1 if some p is outside by more than
// `slack`, and else as it was.
kernel void frames_clip(
    LIGHT_ARGUMENTS,
    real slack,                // light beyond a bound by less counts as inside
    global const real *scales, // unknowns per light, like direct
    global real *x,            // like direct
    global int *exceeded)      // [1]
{
    const int pixel = get_global_id(0);
    if (pixel >= pixels)
        return;
    bool is_outside = false;
    for (int c = 0; c < channels; ++c) {
        const real light = LIGHT(c);
        const bool is_lit = factors[AT(c)] != 0;
        is_outside |= is_lit && !(light >= low - slack && light <= high + slack);
        x[AT(c)] = is_lit ? scales[AT(c)] * clamp(light, low, high) : 0;
    }
    if (is_outside)
        atomic_or(exceeded, 1);
}

// One work-item a pixel.
kernel void frames_encode(
    LIGHT_ARGUMENTS,
    int count,                     // thresholds of a channel
    int cells,                     // of equal width, in which light is looked up
    real cells_per_light,          // 1 / their width
    real first_light,              // where the first begins
    global const int *starts,      // (channels, cells), the place of the light at which each begins
    global const real *thresholds, // (channels, count), ascending
    global CODE *codes)            // (pixels, channels)
{
    const int pixel = get_global_id(0);
    if (pixel >= pixels)
        return;
    for (int c = 0; c < channels; ++c) {
        const real free_light = LIGHT(c);
        const real light = factors[AT(c)] != 0 ? clamp(free_light, low, high) : 0;
#if STEPS
        const int cell = clamp((int)((light - first_light) * cells_per_light), 0, cells - 1);
        global const real *list = thresholds + c * count;
        int place = starts[c * cells + cell];
        for (int step = 0; step < STEPS; ++step)
            place += place < count && light >= list[min(place, count - 1)];
#if BETWEEN
        const int i = clamp(place - 1, 0, count - 2);
        const real width = list[i + 1] - list[i];
        const real share = width > 0 ? clamp((light - list[i]) / width, 0.0f, 1.0f) : 1.0f;
        codes[pixel * channels + c] = (i + share) / (count - 1);
#else
        codes[pixel * channels + c] = place;
#endif
#else
        codes[pixel * channels + c] = light;
#endif
    }
}

// One work-item a strip of neighbouring pixels: the largest share of the way to `high` that some
// light in it goes, both with `shift` added: what the background takes.
kernel void frames_peaks(
    LIGHT_ARGUMENTS,
    int strip,                // pixels of a strip
    real shifts,              // 1: the shift counts
    global const real *shift, // projector light like direct; not read where it does not count
    global real *peaks)       // [strips]
{
    const int number = get_global_id(0);
    const int end = min((number + 1) * strip, pixels);
    real peak = 0;
    for (int pixel = number * strip; pixel < end; ++pixel)
        for (int c = 0; c < channels; ++c) {
            const real added = shifts != 0 ? shift[AT(c)] : 0;
            if (high + added > 0)
                peak = fmax(peak, (LIGHT(c) + added) / (high + added));
        }
    if (number * strip < pixels)
        peaks[number] = peak;
}
