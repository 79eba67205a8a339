//! Products of small matrices, written as loops that the compiler vectorises.
//!
//! Numbers are processed in lanes, groups of 16 successive outputs or inputs. Every result is a single sum in a fixed
//! order. It depends neither on the width of the vectors nor on the other rows of the batch, because a vector holds
//! independent sums. Multiplications and additions are separate instructions: a fused multiply-add rounds differently,
//! and some processors lack it. Therefore all processors compute the same bytes.
//!
//! Loops use indices where an iterator would be easier to read: the compiler did not inline iterators and `from_fn`
//! over arrays into the kernels, and their calls took a third of the time of a small gradient.
#![allow(clippy::needless_range_loop)]

use std::ops::Range;

use pulp::Simd;

use crate::kernel::{Kernel, LANES, Lane, Rows, call, lanes};

/// The initial value of sums without biases.
const ZERO: Lane = [0.0; LANES];

/// A weight matrix in the order in which a product reads it: for each lane (16 outputs) and each input, the weights
/// from this input to these outputs.
#[derive(Clone, Debug)]
pub(crate) struct Matrix {
    inputs: usize,
    /// `[lanes of outputs, inputs]` weights.
    data: Vec<Lane>,
}

impl Matrix {
    pub(crate) fn new(inputs: usize, outputs: usize) -> Self {
        Matrix { inputs, data: vec![[0.0; LANES]; lanes(outputs) * inputs] }
    }

    /// Loads the weights `matrix` `[outputs, n]` of n inputs, starting at input `first`.
    pub(crate) fn load(&mut self, first: usize, matrix: &[f32], outputs: usize) {
        let inputs = matrix.len() / outputs;
        for (block, lanes) in matrix.chunks(LANES * inputs).zip(self.data.chunks_exact_mut(self.inputs)) {
            let lanes = &mut lanes[first..][..inputs];
            // Most columns of a full block are transposed, four at a time. The loop copies all other columns.
            let n_transposed = if block.len() == LANES * inputs { transpose(block, lanes) } else { 0 };
            for (o, row) in block.chunks_exact(inputs).enumerate() {
                lanes[n_transposed..].iter_mut().zip(&row[n_transposed..]).for_each(|(lane, weight)| lane[o] = *weight);
            }
        }
    }

    /// Returns the matrix as the right factor of a product.
    #[inline(always)]
    pub(crate) fn factor(&self) -> Factor<'_> {
        let outputs = self.data.len() / self.inputs * LANES;
        let numbers = self.data.as_flattened();
        Factor { numbers, inputs: self.inputs, outputs, per_column: self.inputs * LANES, per_input: LANES }
    }
}

/// The right factor of a product: a matrix with the strides of its numbers.
#[derive(Clone, Copy)]
pub(crate) struct Factor<'a> {
    numbers: &'a [f32],
    inputs: usize,
    outputs: usize,
    /// Distance in `numbers` from one lane (16 outputs) to the next.
    per_column: usize,
    /// Distance in `numbers` from an input to the next input.
    per_input: usize,
}

impl<'a> Factor<'a> {
    /// Makes a factor of the row-major `matrix` `[inputs, outputs]`, without a copy.
    #[inline(always)]
    pub(crate) fn rows(matrix: &'a [f32], outputs: usize) -> Self {
        Factor { numbers: matrix, inputs: matrix.len() / outputs, outputs, per_column: LANES, per_input: outputs }
    }

    /// Multiplies `rows` of `from` by this matrix and writes the result to the same rows of `to`: to_b = start + Σ_i
    /// from_bi weights_i, added in order of i. `start` has the initial values of all outputs, in lanes; `None` stands
    /// for 0.
    pub(crate) fn apply<S: Simd>(
        self,
        simd: S,
        from: &Rows,
        rows: Range<usize>,
        start: Option<&[Lane]>,
        to: &mut Rows,
    ) {
        call(simd, Apply { factor: self, from, rows, start, to });
    }

    /// Computes the same product as [`Factor::apply`], inlined into its caller. Most rows are computed in blocks of
    /// eight or of four to seven; the last one to three rows are computed singly.
    #[inline(always)]
    pub(crate) fn apply_inline<S: Simd>(
        self,
        simd: S,
        from: &Rows,
        rows: Range<usize>,
        start: Option<&[Lane]>,
        to: &mut Rows,
    ) {
        // Rows `many` are computed in blocks, rows `few` singly.
        let whole = self.outputs / LANES;
        let few = if rows.len() % 8 < 4 { rows.len() % 8 } else { 0 };
        let many = rows.start..rows.end - few;
        let few = rows.end - few..rows.end;
        for column in 0..whole {
            self.columns::<S, true>(simd, from, many.clone(), start, to, column);
        }
        let mut column = 0;
        while column < whole && !few.is_empty() {
            let step = if column + 4 <= whole { 4 } else { 1 };
            for row in few.clone() {
                if step == 4 {
                    self.row_product::<S, 4, true>(simd, from, row, start, to, column);
                } else {
                    self.row_product::<S, 1, true>(simd, from, row, start, to, column);
                }
            }
            column += step;
        }
        if whole * LANES < self.outputs {
            self.columns::<S, false>(simd, from, many, start, to, whole);
            for row in few {
                self.row_product::<S, 1, false>(simd, from, row, start, to, whole);
            }
        }
    }

    /// Computes one lane (16 outputs) for `rows`: eight rows at once, and the last four to seven together. `column` is
    /// the index of the lane. `WHOLE` is true if all [`LANES`] numbers of the lane are outputs.
    #[inline(always)]
    fn columns<S: Simd, const WHOLE: bool>(
        self,
        simd: S,
        from: &Rows,
        rows: Range<usize>,
        start: Option<&[Lane]>,
        to: &mut Rows,
        column: usize,
    ) {
        let mut row = rows.start;
        while row + 8 <= rows.end {
            self.product::<S, 8, WHOLE>(simd, from, row, start, to, column);
            row += 8;
        }
        match rows.end - row {
            4 => self.product::<S, 4, WHOLE>(simd, from, row, start, to, column),
            5 => self.product::<S, 5, WHOLE>(simd, from, row, start, to, column),
            6 => self.product::<S, 6, WHOLE>(simd, from, row, start, to, column),
            7 => self.product::<S, 7, WHOLE>(simd, from, row, start, to, column),
            _ => {}
        }
    }

    /// Returns the weights of lane number `column` (16 outputs), from the first input's to the last input's. These
    /// slices are equally long for all whole lanes, so the compiler can omit repeated bounds checks.
    #[inline(always)]
    fn column<const WHOLE: bool>(self, column: usize) -> &'a [f32] {
        let last = if WHOLE { LANES } else { self.outputs % LANES };
        &self.numbers[column * self.per_column..][..(self.inputs - 1) * self.per_input + last]
    }

    /// Returns one SIMD vector of weights. `column` has the weights of one lane (16 outputs) for all inputs. Those of
    /// input `i` fill one or more SIMD vectors, and `vector` is the index of the returned one.
    #[inline(always)]
    fn vector<S: Simd, const WHOLE: bool>(self, column: &[f32], i: usize, vector: usize) -> S::f32s {
        if WHOLE {
            return S::as_simd_f32s(&column[i * self.per_input + vector * S::F32_LANES..][..S::F32_LANES]).0[0];
        }
        let mut lane = ZERO;
        let left = self.outputs % LANES;
        lane[..left].copy_from_slice(&column[i * self.per_input..][..left]);
        S::as_simd_f32s(&lane).0[vector]
    }

    /// Computes one lane (16 outputs) for `R` rows at once, so that each vector of weights is loaded only once for all
    /// of them.
    #[inline(always)]
    fn product<S: Simd, const R: usize, const WHOLE: bool>(
        self,
        simd: S,
        from: &Rows,
        row: usize,
        start: Option<&[Lane]>,
        to: &mut Rows,
        column: usize,
    ) {
        let weights = self.column::<WHOLE>(column);
        let mut inputs = [&from.row(row)[..self.inputs]; R];
        for r in 1..R {
            inputs[r] = &from.row(row + r)[..self.inputs];
        }
        let (start, _) = S::as_simd_f32s(start.map_or(&ZERO, |start| &start[column]));
        for vector in 0..start.len() {
            let mut sums = [start[vector]; R];
            for i in 0..self.inputs {
                let weights = self.vector::<S, WHOLE>(weights, i, vector);
                for r in 0..R {
                    sums[r] = simd.add_f32s(sums[r], simd.mul_f32s(simd.splat_f32s(inputs[r][i]), weights));
                }
            }
            for r in 0..R {
                S::as_mut_simd_f32s(&mut to.data[(row + r) * to.width + column]).0[vector] = sums[r];
            }
        }
    }

    /// Computes `C` lanes (16 outputs each) for one row. The sums are independent, so the processor can compute them in
    /// parallel.
    #[inline(always)]
    fn row_product<S: Simd, const C: usize, const WHOLE: bool>(
        self,
        simd: S,
        from: &Rows,
        row: usize,
        start: Option<&[Lane]>,
        to: &mut Rows,
        column: usize,
    ) {
        let inputs = &from.row(row)[..self.inputs];
        let mut weights = [self.column::<WHOLE>(column); C];
        for c in 1..C {
            weights[c] = self.column::<WHOLE>(column + c);
        }
        for vector in 0..LANES / S::F32_LANES {
            let mut sums = [simd.splat_f32s(0.0); C];
            if let Some(start) = start {
                for c in 0..C {
                    sums[c] = S::as_simd_f32s(&start[column + c]).0[vector];
                }
            }
            for (i, input) in inputs.iter().enumerate() {
                let input = simd.splat_f32s(*input);
                for c in 0..C {
                    let weights = self.vector::<S, WHOLE>(weights[c], i, vector);
                    sums[c] = simd.add_f32s(sums[c], simd.mul_f32s(input, weights));
                }
            }
            for c in 0..C {
                S::as_mut_simd_f32s(&mut to.data[row * to.width + column + c]).0[vector] = sums[c];
            }
        }
    }
}

/// The arguments of [`Factor::apply`].
struct Apply<'a> {
    factor: Factor<'a>,
    from: &'a Rows,
    rows: Range<usize>,
    start: Option<&'a [Lane]>,
    to: &'a mut Rows,
}

impl Kernel for Apply<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Apply { factor, from, rows, start, to } = self;
        factor.apply_inline(simd, from, rows, start, to);
    }
}

/// Transposes `block` `[LANES, columns]`, four columns at a time. Returns the number of columns that were transposed.
fn transpose(block: &[f32], columns: &mut [Lane]) -> usize {
    let width = columns.len();
    let (columns, _) = columns.as_chunks_mut::<4>();
    for k in 0..LANES / 4 {
        let row = |r: usize| block[(4 * k + r) * width..][..width].as_chunks::<4>().0;
        let rows = row(0).iter().zip(row(1)).zip(row(2)).zip(row(3));
        for ((((a, b), c), d), columns) in rows.zip(&mut *columns) {
            for (column, numbers) in columns.iter_mut().zip(transpose_tile([*a, *b, *c, *d])) {
                column.as_chunks_mut::<4>().0[k] = numbers;
            }
        }
    }
    4 * columns.len()
}

/// Transposes a 4 × 4 matrix with shuffle instructions, which the compiler does not choose by itself.
#[inline(always)]
fn transpose_tile(rows: [[f32; 4]; 4]) -> [[f32; 4]; 4] {
    #[cfg(target_arch = "x86_64")]
    if let Some(sse) = pulp::core_arch::x86::Sse::try_new() {
        let [a, b, c, d] = rows.map(pulp::cast::<_, std::arch::x86_64::__m128>);
        let low = sse._mm_unpacklo_ps(a, b);
        let high = sse._mm_unpackhi_ps(a, b);
        let low_2 = sse._mm_unpacklo_ps(c, d);
        let high_2 = sse._mm_unpackhi_ps(c, d);
        return [
            pulp::cast(sse._mm_movelh_ps(low, low_2)),
            pulp::cast(sse._mm_movehl_ps(low_2, low)),
            pulp::cast(sse._mm_movelh_ps(high, high_2)),
            pulp::cast(sse._mm_movehl_ps(high_2, high)),
        ];
    }
    std::array::from_fn(|column| rows.map(|row| row[column]))
}

/// Computes the outer products Σ_b deltas_bo inputs_bi over the first `n` rows, in order of b. Writes them to `sums`
/// `[outputs, size]`, or adds them to `sums` with `ADD`. `size` is the number of inputs.
pub(crate) fn outer<S: Simd, const ADD: bool>(
    simd: S,
    sums: &mut [f32],
    size: usize,
    deltas: &Rows,
    inputs: &Rows,
    n: usize,
) {
    call(simd, Outer::<ADD> { sums, size, deltas, inputs, n });
}

/// The arguments of [`outer`].
struct Outer<'a, const ADD: bool> {
    sums: &'a mut [f32],
    size: usize,
    deltas: &'a Rows,
    inputs: &'a Rows,
    n: usize,
}

impl<const ADD: bool> Kernel for Outer<'_, ADD> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Outer { sums, size, deltas, inputs, n } = self;
        outer_here::<S, ADD>(simd, sums, size, deltas, inputs, n);
    }
}

/// Computes the same as [`outer`], inlined into its caller.
#[inline(always)]
fn outer_here<S: Simd, const ADD: bool>(
    simd: S,
    sums: &mut [f32],
    size: usize,
    deltas: &Rows,
    inputs: &Rows,
    n: usize,
) {
    let eights = sums.len() / size / 8 * 8;
    let rest = sums.len() / size % 8;
    for column in 0..size / LANES {
        for first in (0..eights).step_by(8) {
            outers::<S, 8, ADD, true>(simd, sums, size, (deltas, first), (inputs, column), n);
        }
        for first in eights..eights + rest {
            outers::<S, 1, ADD, true>(simd, sums, size, (deltas, first), (inputs, column), n);
        }
    }
    if !size.is_multiple_of(LANES) {
        for first in (0..eights).step_by(8) {
            outers::<S, 8, ADD, false>(simd, sums, size, (deltas, first), (inputs, size / LANES), n);
        }
        for first in eights..eights + rest {
            outers::<S, 1, ADD, false>(simd, sums, size, (deltas, first), (inputs, size / LANES), n);
        }
    }
}

/// Computes one lane (16 inputs) of `R` successive rows of `sums`. Each row belongs to an output, and `first` is the
/// index of the first row. `column` is the index of the lane. `WHOLE` is true if all [`LANES`] numbers of the lane are
/// inputs.
#[inline(always)]
fn outers<S: Simd, const R: usize, const ADD: bool, const WHOLE: bool>(
    simd: S,
    sums: &mut [f32],
    size: usize,
    (deltas, first): (&Rows, usize),
    (inputs, column): (&Rows, usize),
    n: usize,
) {
    let (inputs, width, stride) = (inputs.lanes(n), inputs.width, deltas.width * LANES);
    let deltas = deltas.lanes(n).as_flattened();
    let sums = &mut sums[first * size + column * LANES..];
    let left = if WHOLE { LANES } else { size % LANES };
    // `lanes` is a buffer of whole lanes. With `ADD` it starts with the values of `sums`. If the lane has fewer than
    // [`LANES`] inputs, it also collects the results.
    let mut lanes = [ZERO; R];
    if ADD {
        for r in 0..R {
            lanes[r][..left].copy_from_slice(&sums[r * size..][..left]);
        }
    }
    for vector in 0..LANES / S::F32_LANES {
        let mut local = [simd.splat_f32s(0.0); R];
        if ADD {
            for r in 0..R {
                local[r] = S::as_simd_f32s(&lanes[r]).0[vector];
            }
        }
        for b in 0..n {
            let inputs = S::as_simd_f32s(&inputs[b * width + column]).0[vector];
            let deltas = &deltas[b * stride + first..][..R];
            for r in 0..R {
                local[r] = simd.add_f32s(local[r], simd.mul_f32s(simd.splat_f32s(deltas[r]), inputs));
            }
        }
        for r in 0..R {
            if WHOLE {
                let sums = &mut sums[r * size + vector * S::F32_LANES..][..S::F32_LANES];
                S::as_mut_simd_f32s(sums).0[0] = local[r];
            } else {
                S::as_mut_simd_f32s(&mut lanes[r]).0[vector] = local[r];
            }
        }
    }
    if !WHOLE {
        for r in 0..R {
            sums[r * size..][..left].copy_from_slice(&lanes[r][..left]);
        }
    }
}

/// Sums the first `n` rows, in order. Writes the sums to `sums`, or adds them to `sums` with `ADD`.
#[inline(always)]
pub(crate) fn sum_rows<const ADD: bool>(sums: &mut [f32], rows: &Rows, n: usize) {
    if !ADD {
        sums.fill(0.0);
    }
    for row in rows.lanes(n).chunks_exact(rows.width) {
        for (sum, x) in sums.iter_mut().zip(row.as_flattened()) {
            *sum += x;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::{Kernel, lanes, run};
    use crate::math::tanh;
    use crate::random::{Purpose, normal, stream};
    use pulp::Scalar128b;

    const INPUTS: usize = 69;
    const OUTPUTS: usize = 85;

    /// The operations under test: products of `n` rows with a matrix and with its transpose, and sums over the rows.
    struct Products<'a> {
        matrix: &'a Matrix,
        /// `[OUTPUTS, INPUTS]` numbers of `matrix`.
        flat: &'a [f32],
        from: &'a Rows,
        n: usize,
        start: &'a [Lane],
        to: &'a mut Rows,
        back: &'a mut Rows,
        outer: &'a mut [f32],
        sum: &'a mut [f32],
    }

    impl Kernel for Products<'_> {
        fn run<S: Simd>(self, simd: S) {
            let Products { matrix, flat, from, n, start, to, back, outer: products, sum } = self;
            matrix.factor().apply(simd, from, 0..n, Some(start), to);
            to.squash(0..n);
            Factor::rows(flat, INPUTS).apply(simd, to, 0..n, None, back);
            outer::<S, false>(simd, products, INPUTS, to, from, n);
            outer::<S, true>(simd, products, INPUTS, to, from, n);
            sum_rows::<false>(sum, to, n);
            sum_rows::<true>(sum, to, n);
        }
    }

    fn numbers(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = stream(seed, Purpose::Weights);
        (0..n).map(|_| normal(&mut rng) as f32).collect()
    }

    /// Returns the results of `run` as bits.
    fn bits(n: usize, run: impl FnOnce(Products<'_>)) -> Vec<u32> {
        let flat = numbers(INPUTS * OUTPUTS, 1);
        let mut matrix = Matrix::new(INPUTS, OUTPUTS);
        matrix.load(0, &flat, OUTPUTS);
        let mut from = Rows::new(n, INPUTS);
        let mut to = Rows::new(n, OUTPUTS);
        let mut back = Rows::new(n, INPUTS);
        from.copy(0, &numbers(n * INPUTS, 2), INPUTS);
        let mut start = [[0.0; LANES]; lanes(OUTPUTS)];
        start.as_flattened_mut()[..OUTPUTS].copy_from_slice(&numbers(OUTPUTS, 3));
        let mut outer = vec![f32::NAN; INPUTS * OUTPUTS];
        let mut sum = vec![f32::NAN; OUTPUTS];
        run(Products {
            matrix: &matrix,
            flat: &flat,
            from: &from,
            n,
            start: &start,
            to: &mut to,
            back: &mut back,
            outer: &mut outer,
            sum: &mut sum,
        });
        let rows = |rows: &Rows, length| (0..n).flat_map(|b| rows.row(b)[..length].to_vec()).collect::<Vec<f32>>();
        let all = [rows(&to, OUTPUTS), rows(&back, INPUTS), outer, sum];
        all.concat().iter().map(|x| x.to_bits()).collect()
    }

    /// Computes the same results by their definitions, one number at a time.
    fn naive(n: usize) -> Vec<u32> {
        let matrix = numbers(INPUTS * OUTPUTS, 1);
        let rows = numbers(n * INPUTS, 2);
        let start = numbers(OUTPUTS, 3);
        let mut to = vec![0.0; n * OUTPUTS];
        let mut back = vec![0.0; n * INPUTS];
        let mut outer = vec![0.0; INPUTS * OUTPUTS];
        let mut sum = vec![0.0; OUTPUTS];
        for twice in [false, true] {
            for (b, row) in rows.chunks_exact(INPUTS).enumerate() {
                for o in 0..OUTPUTS {
                    let dot = (0..INPUTS).fold(start[o], |sum, i| sum + row[i] * matrix[o * INPUTS + i]);
                    let x = tanh(dot);
                    to[b * OUTPUTS + o] = x;
                    sum[o] += x;
                    for i in 0..INPUTS {
                        outer[o * INPUTS + i] += x * row[i];
                        back[b * INPUTS + i] += if twice { 0.0 } else { x * matrix[o * INPUTS + i] };
                    }
                }
            }
        }
        [to, back, outer, sum].concat().iter().map(|x: &f32| x.to_bits()).collect()
    }

    #[test]
    fn every_vector_unit_computes_the_same_bytes() {
        for n in [1, 2, 3, 4, 5, 6, 7, 8, 13, 64] {
            let expected = naive(n);
            assert_eq!(bits(n, |products| run(products)), expected, "{n} rows, the widest");
            assert_eq!(bits(n, |products| products.run(Scalar128b)), expected, "{n} rows, 128 bits");
            #[cfg(target_arch = "x86_64")]
            {
                if let Some(simd) = pulp::x86::V3::try_new() {
                    assert_eq!(bits(n, |products| products.run(simd)), expected, "{n} rows, AVX2");
                }
                if let Some(simd) = pulp::x86::V4::try_new() {
                    assert_eq!(bits(n, |products| products.run(simd)), expected, "{n} rows, AVX-512");
                }
            }
        }
    }
}
