// The data of a page: base64, and gzip.

/** An error about a page that cannot be shown; its message is for people. */
class Refused extends Error {}

/** Return the bytes of base64 text. */
function bytesOf(text) {
  let binary;
  try {
    binary = atob(text.trim());
  } catch (error) {
    throw new Refused("The data in this page are damaged: they are not base64. Copy or export the page again.");
  }
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** Return the content of a gzip file, unpacked by the browser if it can, else by `inflate`. */
async function gunzip(bytes, plain) {
  const damaged = "The data in this page are damaged or truncated. Copy or export the page again.";
  if (bytes.length < 18 || bytes[0] !== 0x1f || bytes[1] !== 0x8b || bytes[2] !== 8) throw new Refused(damaged);
  try {
    if (!plain && typeof DecompressionStream === "function") {
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
      return new Uint8Array(await new Response(stream).arrayBuffer());
    }
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const start = bytes[3] & 16 ? bytes.indexOf(0, 10) + 1 : 10; // behind the comment
    const out = inflate(bytes.subarray(start, bytes.length - 8), view.getUint32(bytes.length - 4, true));
    if (crc32(out) !== view.getUint32(bytes.length - 8, true)) throw new Error("checksum");
    return out;
  } catch (error) {
    throw new Refused(damaged);
  }
}

/** Return the CRC-32 of bytes, as gzip has it. */
function crc32(bytes) {
  const table = new Uint32Array(256);
  for (let n = 0; n < 256; n++) {
    let value = n;
    for (let k = 0; k < 8; k++) value = value & 1 ? 0xedb88320 ^ (value >>> 1) : value >>> 1;
    table[n] = value;
  }
  let crc = 0xffffffff;
  for (let i = 0; i < bytes.length; i++) crc = table[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}

/** Return `size` bytes that DEFLATE (RFC 1951) has compressed. */
function inflate(input, size) {
  const out = new Uint8Array(size);
  let at = 0, end = 0, held = 0, count = 0;
  const bits = (wanted) => {
    while (count < wanted) {
      if (at >= input.length) throw new Error("truncated");
      held |= input[at++] << count;
      count += 8;
    }
    const value = held & ((1 << wanted) - 1);
    held >>>= wanted;
    count -= wanted;
    return value;
  };
  // Canonical codes: how many there are of each length, and the symbols in the order of their codes.
  const codes = (lengths) => {
    const counts = new Uint16Array(16), starts = new Uint16Array(16), symbols = new Uint16Array(lengths.length);
    for (const length of lengths) counts[length]++;
    counts[0] = 0;
    for (let i = 1; i < 15; i++) starts[i + 1] = starts[i] + counts[i];
    lengths.forEach((length, symbol) => { if (length) symbols[starts[length]++] = symbol; });
    return { counts, symbols };
  };
  const symbol = ({ counts, symbols }) => {
    let code = 0, first = 0, index = 0;
    for (let length = 1; length < 16; length++) {
      code |= bits(1);
      if (code - first < counts[length]) return symbols[index + code - first];
      index += counts[length];
      first = (first + counts[length]) << 1;
      code <<= 1;
    }
    throw new Error("no such code");
  };
  const lengthBase = [], lengthBits = [], distanceBase = [], distanceBits = [];
  for (let i = 0, base = 3; i < 28; i++) {
    lengthBase.push(base);
    lengthBits.push(i < 8 ? 0 : (i >> 2) - 1);
    base += 1 << lengthBits[i];
  }
  lengthBase.push(258);
  lengthBits.push(0);
  for (let i = 0, base = 1; i < 30; i++) {
    distanceBase.push(base);
    distanceBits.push(i < 4 ? 0 : (i >> 1) - 1);
    base += 1 << distanceBits[i];
  }
  const fixed = [
    codes(Array.from({ length: 288 }, (_, i) => (i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8))),
    codes(new Array(30).fill(5)),
  ];
  const dynamic = () => {
    const literals = bits(5) + 257, distances = bits(5) + 1, given = bits(4) + 4, lengths = new Array(19).fill(0);
    const order = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
    for (let i = 0; i < given; i++) lengths[order[i]] = bits(3);
    const outer = codes(lengths), all = [];
    while (all.length < literals + distances) {
      const value = symbol(outer);
      if (value < 16) { all.push(value); continue; }
      const [repeated, times] = value === 16 ? [all[all.length - 1], 3 + bits(2)]
        : value === 17 ? [0, 3 + bits(3)] : [0, 11 + bits(7)];
      for (let i = 0; i < times; i++) all.push(repeated);
    }
    return [codes(all.slice(0, literals)), codes(all.slice(literals, literals + distances))];
  };
  for (let last = 0; !last;) {
    last = bits(1);
    const kind = bits(2);
    if (kind === 0) {
      held = count = 0;
      const length = input[at] | (input[at + 1] << 8);
      out.set(input.subarray(at + 4, at + 4 + length), end);
      at += 4 + length;
      end += length;
      continue;
    }
    if (kind === 3) throw new Error("no such block");
    const [literals, distances] = kind === 1 ? fixed : dynamic();
    for (let value; (value = symbol(literals)) !== 256;) {
      if (value < 256) { out[end++] = value; continue; }
      const length = lengthBase[value - 257] + bits(lengthBits[value - 257]);
      const code = symbol(distances), from = end - distanceBase[code] - bits(distanceBits[code]);
      if (from < 0 || end + length > size) throw new Error("out of range");
      for (let i = 0; i < length; i++) out[end + i] = out[from + i];
      end += length;
    }
  }
  if (end !== size) throw new Error("truncated");
  return out;
}
