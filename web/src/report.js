// Polarization of separated images and what the user should know: twin of polsep/separation/report.py.

const MIN_CONCENTRATION = 0.34, MIN_CONCENTRATION_CLOSED = 0.29, MAX_RESIDUAL = 0.07, MAX_DOLP = 2;

/** Degree (0 where s0 <= 0, at most 2) and angle [rad, in [0, pi)] of linear polarization, Dave et al. 2022, Eq. 2. */
export function addPolarization(images) {
  const { s0, s1, s2 } = images, n = s0.length;
  images.dolp = new Float32Array(n);
  images.aolp = new Float32Array(n);
  for (let k = 0; k < n; k++) {
    images.dolp[k] = s0[k] > 0 ? Math.min(Math.sqrt(s1[k] * s1[k] + s2[k] * s2[k]) / s0[k], MAX_DOLP) : 0;
    const angle = 0.5 * Math.atan2(s2[k] + 0, s1[k] + 0);
    images.aolp[k] = angle < 0 ? angle + Math.PI : angle;
    if (images.aolp[k] >= Math.PI) images.aolp[k] = 0;
  }
}

/** Sums over all pixels; of the formula the strength of the polarized light weighs its direction. */
export function tallyOf(images) {
  const { s0, s1, s2, specular, diffuse, colors, valid, clipped, dolp } = images, n = s0.length;
  const counts = { frame: n, valid: 0, clipped: 0, above: 0 };
  for (let k = 0; k < n; k++) {
    counts.valid += valid[k];
    counts.clipped += clipped[k];
    counts.above += dolp[k] > 1;
  }
  if (images.sums) return { ...counts, ...images.sums };  // of the network
  const sums = { pixels: n, s0: 0, specular: 0, power: 0, along: 0, across: 0, residual: 0 };
  for (let k = 0; k < n * colors; k++) {
    sums.s0 += (diffuse[k] + specular[k]) / colors;
    sums.specular += specular[k] / colors;
  }
  for (let k = 0; k < n; k++) {
    const square = s1[k] * s1[k] + s2[k] * s2[k], strength = Math.sqrt(square);
    sums.power += square;
    sums.along += strength * s1[k];
    sums.across += strength * s2[k];
  }
  return { ...counts, ...sums };
}

/** Statistics of a frame and lines for the user; `network`: of the method joint-fast. */
export function describe(sums, network, colors) {
  const angle = (0.5 * Math.atan2(sums.across, sums.along) + Math.PI) % Math.PI, warnings = [];
  const concentration = sums.power > 0 ? Math.hypot(sums.along, sums.across) / sums.power : 0;
  const brightness = sums.s0 / sums.pixels, misfit = sums.s0 > 0 ? sums.residual / sums.s0 : 0;
  if (brightness > 1e-3 && concentration < (network ? MIN_CONCENTRATION : MIN_CONCENTRATION_CLOSED))
    warnings.push("polarized light of one angle was expected, found many (concentration " +
      `${concentration.toFixed(2)}): is the light polarized, and the only one?`);
  if (network && colors === 3 && brightness > 1e-3 && misfit > MAX_RESIDUAL)
    warnings.push("white highlights on coloured objects were expected, found polarization of other colours (misfit " +
      `${misfit.toFixed(2)} of the light): are there metals, or several lights?`);
  const statistics = {
    clipped_fraction: sums.clipped / sums.frame,
    valid_fraction: sums.valid / sums.frame,
    mean_s0: brightness,
    specular_fraction: sums.s0 > 0 ? sums.specular / sums.s0 : 0,
    dolp_above_1_fraction: sums.above / sums.frame,
    specular_aolp_deg: (angle * 180) / Math.PI,
    specular_aolp_concentration: concentration,
  };
  return { statistics, warnings };
}

/** Multiply the light's colour back into diffuse and specular, in place. */
export function intoLight(images, light) {
  const { diffuse, specular, colors } = images;
  if (light.every((gain) => gain === 1)) return;
  for (let k = 0; k < diffuse.length; k++) {
    diffuse[k] *= light[k % colors];
    specular[k] *= light[k % colors];
  }
  if (images.error) {
    const gain = light.reduce((a, b) => a + b) / light.length;
    images.error.forEach((value, k) => (images.error[k] = value * gain));
  }
}
