// SPDX-License-Identifier: BSD-3-Clause
// Bytes of a message, the same both ways and on any carrier: the length of the header as uint32 (little-endian), the header as
// JSON padded with spaces so that arrays begin at a multiple of 4, then the arrays, each padded to 4 bytes.

const TYPES = { f4: Float32Array, u1: Uint8Array }; // light, codes

export class Pixels {
  // A picture of h x w pixels and c numbers each, row by row.
  constructor(data, [h, w, c]) {
    Object.assign(this, { data, h, w, c });
  }

  at(row, col) {
    const first = (row * this.w + col) * this.c;
    return [...this.data.subarray(first, first + this.c)];
  }

  // Of codes: as a canvas takes them.
  image() {
    const { data, h, w, c } = this, image = new ImageData(w, h), rgba = image.data.fill(255);
    for (let i = 0; i < h * w; i++) {
      for (let k = 0; k < 3; k++) rgba[4 * i + k] = data[i * c + (c === 3 ? k : 0)];
    }
    return image;
  }

  // What to show as white: this share of pixels is darker. The brightest would often leave the rest black.
  white(share = 0.99) {
    const n = this.h * this.w, step = Math.max(1, Math.floor(n / 4096));
    const light = new Float32Array(Math.ceil(n / step)); // whose numbers are sorted fast
    for (let i = 0; i < n; i += step) {
      let most = 0;
      for (let k = 0; k < this.c; k++) most = Math.max(most, Math.abs(this.data[i * this.c + k]));
      light[i / step] = most;
    }
    light.sort();
    return light[Math.floor(share * (light.length - 1))] || light[light.length - 1];
  }
}

const padded = (length) => Math.ceil(length / 4) * 4;

export function encode(header, arrays = {}) {
  const names = Object.keys(arrays);
  if (!names.length) return JSON.stringify(header);
  const list = names.map((name) => {
    const { h, w, c, length } = arrays[name]; // a picture, or the bytes of a file
    return { name, shape: length === undefined ? [h, w, c] : [length], dtype: "u1" };
  });
  const json = new TextEncoder().encode(JSON.stringify({ ...header, arrays: list }));
  const start = padded(4 + json.length);
  const contents = names.map((name) => arrays[name].data ?? arrays[name]);
  const size = contents.reduce((sum, { byteLength }) => sum + padded(byteLength), start);
  const bytes = new Uint8Array(size);
  new DataView(bytes.buffer).setUint32(0, start - 4, true);
  bytes.fill(32, 4, start).set(json, 4);
  let offset = start;
  for (const { buffer, byteOffset, byteLength } of contents) {
    bytes.set(new Uint8Array(buffer, byteOffset, byteLength), offset);
    offset += padded(byteLength);
  }
  return bytes;
}

export function decode(message) {
  if (typeof message === "string") return { ...JSON.parse(message), arrays: {} };
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  const arrays = {};
  let offset = 4 + length;
  for (const { name, shape, dtype } of header.arrays) {
    const data = new TYPES[dtype](message, offset, shape.reduce((a, b) => a * b));
    arrays[name] = shape.length === 1 ? data : new Pixels(data, shape);
    offset += padded(data.byteLength);
  }
  return { ...header, arrays };
}
