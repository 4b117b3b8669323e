// Vectors and layers, as `gacrl.networks.layers` has them: W x + b, one vector at a time.

// A layer whose weight has a row of `columns` numbers for each output.
export function layerOf(weight, bias, rows) {
  return { weight, bias, rows, columns: weight.length / rows };
}

// W x + b. `from`: the first column that x stands for, where x is only a part of what the layer takes.
export function affine(layer, x, y = new Float64Array(layer.rows), from = 0) {
  const { weight, bias, rows, columns } = layer;
  for (let row = 0; row < rows; row++) {
    let sum = bias === null ? 0 : bias[row];
    const start = row * columns + from;
    for (let column = 0; column < x.length; column++) sum += weight[start + column] * x[column];
    y[row] = sum;
  }
  return y;
}

// y + W x, of the columns from `from` on.
export function addProduct(layer, x, y, from = 0) {
  const { weight, rows, columns } = layer;
  for (let row = 0; row < rows; row++) {
    const start = row * columns + from;
    let sum = 0;
    for (let column = 0; column < x.length; column++) sum += weight[start + column] * x[column];
    y[row] += sum;
  }
  return y;
}

// x where it is positive, else slope · x, in place.
export function rectify(x, slope = 0) {
  for (let i = 0; i < x.length; i++) if (x[i] < 0) x[i] *= slope;
  return x;
}

// Layers with a ReLU after each of them.
export function mlp(layers, x, slope = 0) {
  return layers.reduce((vector, layer) => rectify(affine(layer, vector), slope), x);
}

export function dot(a, b) {
  let sum = 0;
  for (let i = 0; i < a.length; i++) sum += a[i] * b[i];
  return sum;
}

export function concat(...parts) {
  const whole = new Float64Array(parts.reduce((size, part) => size + part.length, 0));
  let end = 0;
  for (const part of parts) {
    whole.set(part, end);
    end += part.length;
  }
  return whole;
}

// The shares that a softmax of the scores gives; [] where there are none.
export function softmax(scores) {
  const largest = Math.max(...scores);
  const weights = Array.from(scores, (score) => Math.exp(score - largest));
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  return weights.map((weight) => weight / total);
}

// The mean of vectors of this size, weighted by shares that add up to 1; zeros where there are none.
export function mixture(vectors, shares, size) {
  const mean = new Float64Array(size);
  vectors.forEach((vector, k) => {
    for (let i = 0; i < size; i++) mean[i] += shares[k] * vector[i];
  });
  return mean;
}

// Raises `largest` to x, number by number.
export function raise(largest, x) {
  for (let i = 0; i < x.length; i++) if (x[i] > largest[i]) largest[i] = x[i];
  return largest;
}

export function indexOfLargest(values, allowed = null) {
  let best = -1;
  for (let i = 0; i < values.length; i++) {
    if ((allowed === null || allowed[i]) && (best < 0 || values[i] > values[best])) best = i;
  }
  return best;
}

export function oneHot(index, size) {
  const vector = new Float64Array(size);
  if (index >= 0) vector[index] = 1;
  return vector;
}
