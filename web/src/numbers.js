// Small statistics with NumPy's definitions.

export const sum = (values) => { let total = 0; for (const value of values) total += value; return total; };
export const mean = (values) => sum(values) / values.length;
export const sorted = (values) => Float64Array.from(values).sort();

/** The quantile of ascending values, linear between two. */
export function quantileOfSorted(ordered, share) {
  const at = share * (ordered.length - 1), k = Math.floor(at), next = Math.min(k + 1, ordered.length - 1);
  return ordered[k] + (at - k) * (ordered[next] - ordered[k]);
}

export const quantile = (values, share) => quantileOfSorted(sorted(values), share);
export const median = (values) => quantile(values, 0.5);

/** The middle value by weight. */
export function weightedMedian(values, weights) {
  const order = Array.from(values, (_, k) => k).sort((a, b) => values[a] - values[b]);
  let total = 0;
  const half = sum(weights) / 2;
  for (const k of order) {
    total += weights[k];
    if (total >= half) return values[k];
  }
  return 0;
}

/** The solution of a square system, by elimination with pivots; rows of `matrix` and `right` are changed. */
export function solve(matrix, right) {
  const n = right.length;
  for (let k = 0; k < n; k++) {
    let pivot = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(matrix[i][k]) > Math.abs(matrix[pivot][k])) pivot = i;
    [matrix[k], matrix[pivot]] = [matrix[pivot], matrix[k]];
    [right[k], right[pivot]] = [right[pivot], right[k]];
    for (let i = k + 1; i < n; i++) {
      const factor = matrix[i][k] / matrix[k][k];
      if (factor === 0) continue;
      for (let j = k; j < n; j++) matrix[i][j] -= factor * matrix[k][j];
      right[i] -= factor * right[k];
    }
  }
  for (let k = n - 1; k >= 0; k--) {
    for (let j = k + 1; j < n; j++) right[k] -= matrix[k][j] * right[j];
    right[k] /= matrix[k][k];
  }
  return right;
}
