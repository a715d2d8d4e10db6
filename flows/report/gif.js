// An animation as GIF 89a: one palette for all frames, LZW compression.
"use strict";
(() => {
  const DIGITS = 5;   // bits of red, green and blue by which colours are counted

  // The 256 most frequent colours, and the nearest of them for each colour.
  function palette(pictures) {
    const counts = new Uint32Array(1 << (3 * DIGITS));
    const key = (data, at) => (data[at] >> 3) << 10 | (data[at + 1] >> 3) << 5 | data[at + 2] >> 3;
    for (const data of pictures) for (let at = 0; at < data.length; at += 4) counts[key(data, at)]++;
    const parts = (k) => [k >> 10, (k >> 5) & 31, k & 31].map((v) => v << 3 | v >> 2);
    const used = [...counts.keys()].filter((k) => counts[k]).sort((a, b) => counts[b] - counts[a]);
    const colours = used.slice(0, 256).map(parts);
    const nearest = new Uint8Array(counts.length);
    used.forEach((k, place) => {
      if (place < 256) { nearest[k] = place; return; }
      const [r, g, b] = parts(k);
      let best = Infinity;
      colours.forEach((one, i) => {
        const far = (one[0] - r) ** 2 + (one[1] - g) ** 2 + (one[2] - b) ** 2;
        if (far < best) [nearest[k], best] = [i, far];
      });
    });
    return { colours, rows: (data) => Uint8Array.from({ length: data.length / 4 }, (_, i) => nearest[key(data, 4 * i)]) };
  }

  // LZW with codes of 9 to 12 bits, in blocks of 255 bytes.
  function packed(rows) {
    const out = [8], block = [];
    const next = new Uint16Array(4096 * 256);   // the code of a code followed by a byte, 0 if none
    let word = 0, held = 0, size = 9, free = 258;
    const byte = (value) => {
      block.push(value);
      if (block.length === 255) { out.push(255, ...block); block.length = 0; }
    };
    const put = (code) => {
      word |= code << held;
      held += size;
      while (held >= 8) { byte(word & 255); word >>>= 8; held -= 8; }
    };
    put(256);
    let code = rows[0];
    for (let i = 1; i < rows.length; i++) {
      const at = code << 8 | rows[i];
      if (next[at]) { code = next[at]; continue; }
      put(code);
      if (free < 4096) {
        if (free === 1 << size) size++;
        next[at] = free++;
      } else {
        put(256);
        next.fill(0);
        [size, free] = [9, 258];
      }
      code = rows[i];
    }
    put(code);
    if (free === 1 << size && size < 12) size++;
    put(257);
    if (held) byte(word & 255);
    if (block.length) out.push(block.length, ...block);
    out.push(0);
    return Uint8Array.from(out);
  }

  // pictures: frames {width, height, data} of one size with four bytes per pixel; pause: seconds.
  modetune.gif = (pictures, pause) => {
    const { width, height } = pictures[0], short = (n) => [n & 255, n >> 8];
    const { colours, rows } = palette(pictures.map((one) => one.data));
    const table = Array.from({ length: 256 }, (_, i) => colours[i] || [0, 0, 0]).flat();
    const text = (letters) => [...letters].map((c) => c.charCodeAt(0));
    const parts = [Uint8Array.from([
      ...text("GIF89a"), ...short(width), ...short(height), 0xf7, 0, 0, ...table,
      0x21, 0xff, 11, ...text("NETSCAPE2.0"), 3, 1, 0, 0, 0,   // loop for ever
    ])];
    for (const { data } of pictures) {
      parts.push(Uint8Array.from([
        0x21, 0xf9, 4, 4, ...short(Math.round(100 * pause)), 0, 0,
        0x2c, 0, 0, 0, 0, ...short(width), ...short(height), 0,
      ]), packed(rows(data)));
    }
    parts.push(Uint8Array.from([0x3b]));
    return new Blob(parts, { type: "image/gif" });
  };
})();
