// Messages: a header in JSON and named arrays behind it, in one buffer. Both ways, by a socket or a notebook's widget.
//
//   bytes 0-3   length H of the header, unsigned, little-endian (as all numbers are)
//   then        H bytes of JSON in UTF-8, with spaces at its end so that what follows begins at a multiple of 8
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

/** A buffer from a header and arrays by their names: `{name: typed array}`, of one dimension. */
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

/** `{header, arrays}` of a buffer; the arrays are views of it, flat, their shapes in `header.arrays`. */
export function decodeFrame(data) {
  // A widget's buffer is a part of another one, and typed arrays want to begin at multiples of their own size.
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
