// Messages in one buffer: a JSON header followed by named arrays. The format is the same in both directions and for
// sockets and notebook widgets.
//
//   bytes 0-3   length H of the header, unsigned, little-endian (as all numbers are)
//   then        H bytes of JSON in UTF-8, padded with spaces so that the arrays begin at a multiple of 8
//   then        the arrays, each at a multiple of 8 from there: header.arrays = {name: [type, shape, offset]}

const TYPES = {
  u1: Uint8Array,
  u4: Uint32Array,
  i4: Int32Array,
  f4: Float32Array,
  f8: Float64Array,
};

const nameOfType = (array) => Object.keys(TYPES).find((name) => array instanceof TYPES[name]);
const padded = (bytes) => Math.ceil(bytes / 8) * 8;

/** Return the buffer of a header and arrays by name: `{name: typed array}`, one-dimensional. */
export function encodeFrame(header, arrays = {}) {
  const described = {};
  let offset = 0;
  for (const [name, array] of Object.entries(arrays)) {
    described[name] = [nameOfType(array), [array.length], offset];
    offset += padded(array.byteLength);
  }
  const text = new TextEncoder().encode(JSON.stringify({ ...header, arrays: described }));
  const start = padded(4 + text.length);
  const buffer = new ArrayBuffer(start + offset);
  const bytes = new Uint8Array(buffer).fill(32, 4, start);
  new DataView(buffer).setUint32(0, start - 4, true);
  bytes.set(text, 4);
  for (const [name, array] of Object.entries(arrays)) {
    bytes.set(new Uint8Array(array.buffer, array.byteOffset, array.byteLength), start + described[name][2]);
  }
  return buffer;
}

/** Decode a buffer to `{header, arrays}`; the arrays are flat views of it, with their shapes in `header.arrays`. */
export function decodeFrame(data) {
  // A widget's buffer may be unaligned within another one, but typed arrays must be aligned to their element size.
  const buffer = data instanceof ArrayBuffer ? data : data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  for (const [name, [type, shape, offset]] of Object.entries(header.arrays)) {
    const count = shape.reduce((product, extent) => product * extent, 1);
    arrays[name] = new TYPES[type](buffer, 4 + length + offset, count);
  }
  return { header, arrays };
}
