// Sizes that files claim: twin of polsep/io/store/header_checks.py.

const MAX_SAMPLES = 3e7;

/** Throw on a size that is too large, before anything of that size is made. */
export function requireSize(width, height) {
  if (width * height > MAX_SAMPLES)
    throw new Error(`expected a frame of at most ${MAX_SAMPLES / 1e6} million samples, found ${width}x${height}`);
}
