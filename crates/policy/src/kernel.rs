//! Products of small matrices, as loops that the compiler turns into vector instructions.
//!
//! Every number is one sum in one order, whatever the width of the vectors and the other rows of a batch: vectors run
//! over numbers that do not wait for each other. Multiplications and additions stay apart, for a fused one rounds
//! differently, and not every processor has it. So the bytes are the same on all.
//!
//! Loops count where an iterator would read better: iterators and `from_fn` over arrays were not compiled into the kernels,
//! and their calls took a third of a small gradient.
#![allow(clippy::needless_range_loop)]

use pulp::{Arch, Scalar128b, Simd, WithSimd};

use crate::math::tanh;

/// Numbers that are computed side by side.
pub(crate) const LANES: usize = 16;

/// Numbers side by side.
pub(crate) type Lane = [f32; LANES];

/// A sum's start where there is none.
const ZERO: Lane = [0.0; LANES];

/// Work that is compiled for every kind of vector unit.
pub(crate) trait Kernel {
    /// Does it with vectors of `simd`. To be inlined.
    fn run<S: Simd>(self, simd: S);
}

/// Does `kernel` with the widest vectors that this processor has.
pub(crate) fn run(kernel: impl Kernel) {
    struct Compiled<K>(K);
    impl<K: Kernel> WithSimd for Compiled<K> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            // Every x86-64 processor has vectors of four numbers.
            if S::F32_LANES == 1 { self.0.run(Scalar128b) } else { self.0.run(simd) }
        }
    }
    Arch::new().dispatch(Compiled(kernel));
}

/// [`LANES`] that `n` numbers fill.
pub(crate) const fn lanes(n: usize) -> usize {
    n.div_ceil(LANES)
}

/// A matrix whose rows are filled up with zeros to whole lanes.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    /// Lanes in a row.
    width: usize,
    data: Vec<Lane>,
}

impl Rows {
    /// Zeros, `n` rows of `length` numbers.
    pub(crate) fn new(n: usize, length: usize) -> Self {
        Rows { width: lanes(length), data: vec![[0.0; LANES]; n * lanes(length)] }
    }

    /// Row `n`, with what fills it up.
    #[inline(always)]
    pub(crate) fn row(&self, n: usize) -> &[f32] {
        self.data[n * self.width..][..self.width].as_flattened()
    }

    /// The same, to be changed.
    #[inline(always)]
    pub(crate) fn row_mut(&mut self, n: usize) -> &mut [f32] {
        self.data[n * self.width..][..self.width].as_flattened_mut()
    }

    /// Copies rows of `length` numbers to the front of the first ones.
    pub(crate) fn copy(&mut self, rows: &[f32], length: usize) {
        for (n, row) in rows.chunks_exact(length).enumerate() {
            self.row_mut(n)[..length].copy_from_slice(row);
        }
    }

    /// The first `n` rows.
    #[inline(always)]
    pub(crate) fn lanes(&self, n: usize) -> &[Lane] {
        &self.data[..n * self.width]
    }

    /// The same, to be changed.
    #[inline(always)]
    pub(crate) fn lanes_mut(&mut self, n: usize) -> &mut [Lane] {
        &mut self.data[..n * self.width]
    }

    /// tanh of the first `n` rows.
    #[inline(always)]
    pub(crate) fn squash(&mut self, n: usize) {
        for lane in self.lanes_mut(n) {
            for x in lane {
                *x = tanh(*x);
            }
        }
    }

    /// Multiplies the first `n` rows, derivatives by a tanh, by 1 - tanh²: `tanhs` are what the tanh gave.
    #[inline(always)]
    pub(crate) fn differentiate_tanh(&mut self, tanhs: &Rows, n: usize) {
        for (lane, tanhs) in self.lanes_mut(n).iter_mut().zip(tanhs.lanes(n)) {
            for (x, tanh) in lane.iter_mut().zip(tanhs) {
                *x *= 1.0 - tanh * tanh;
            }
        }
    }
}

/// A matrix in the order in which a product reads it: for each lane of outputs, for each input, that input's weights.
#[derive(Clone, Debug)]
pub(crate) struct Matrix {
    inputs: usize,
    /// [lanes of outputs, inputs].
    data: Vec<Lane>,
}

impl Matrix {
    pub(crate) fn new(inputs: usize, outputs: usize) -> Self {
        Matrix { inputs, data: vec![[0.0; LANES]; lanes(outputs) * inputs] }
    }

    /// Takes over the weights of the inputs from `first` on: `matrix` [outputs, their number].
    pub(crate) fn load(&mut self, first: usize, matrix: &[f32], outputs: usize) {
        let inputs = matrix.len() / outputs;
        for (block, lanes) in matrix.chunks(LANES * inputs).zip(self.data.chunks_exact_mut(self.inputs)) {
            let lanes = &mut lanes[first..][..inputs];
            let tiled = if block.len() == LANES * inputs { inputs / 4 * 4 } else { 0 };
            for (tile, lanes) in lanes[..tiled].as_chunks_mut::<4>().0.iter_mut().enumerate() {
                transpose(block, inputs, 4 * tile, lanes);
            }
            // In the order of writing.
            for (i, lane) in lanes.iter_mut().enumerate().skip(tiled) {
                lane.iter_mut().zip(block[i..].iter().step_by(inputs)).for_each(|(x, weight)| *x = *weight);
            }
        }
    }

    /// Takes over the transposed `matrix` [inputs, outputs].
    pub(crate) fn load_transposed(&mut self, matrix: &[f32]) {
        for (i, row) in matrix.chunks_exact(matrix.len() / self.inputs).enumerate() {
            for (numbers, lanes) in row.chunks(LANES).zip(self.data.chunks_exact_mut(self.inputs)) {
                lanes[i][..numbers.len()].copy_from_slice(numbers);
            }
        }
    }

    /// The first `n` rows of `from` times this: to_b = start + Σ_i from_bi weights_i, added up in order of i. `start` has one
    /// lane for each of outputs.
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(&self, simd: S, from: &Rows, n: usize, start: Option<&[Lane]>, to: &mut Rows) {
        for (column, weights) in self.data.chunks_exact(self.inputs).enumerate() {
            let start = start.map_or(&ZERO, |start| &start[column]);
            let mut row = 0;
            while row + 8 <= n {
                product::<S, 8>(simd, from, row, weights, start, to, column);
                row += 8;
            }
            match n - row {
                4 => product::<S, 4>(simd, from, row, weights, start, to, column),
                5 => product::<S, 5>(simd, from, row, weights, start, to, column),
                6 => product::<S, 6>(simd, from, row, weights, start, to, column),
                7 => product::<S, 7>(simd, from, row, weights, start, to, column),
                _ => {}
            }
        }
        let few = if n % 8 < 4 { n % 8 } else { 0 };
        for row in n - few..n {
            let columns = self.data.len() / self.inputs;
            let mut column = 0;
            while column + 4 <= columns {
                self.row_product::<S, 4>(simd, from, row, start, to, column);
                column += 4;
            }
            while column < columns {
                self.row_product::<S, 1>(simd, from, row, start, to, column);
                column += 1;
            }
        }
    }

    /// One row, `C` columns at once: sums that do not wait for each other.
    #[inline(always)]
    fn row_product<S: Simd, const C: usize>(
        &self,
        simd: S,
        from: &Rows,
        row: usize,
        start: Option<&[Lane]>,
        to: &mut Rows,
        column: usize,
    ) {
        let inputs = &from.row(row)[..self.inputs];
        let (weights, _) = S::as_simd_f32s(self.data[column * self.inputs..][..C * self.inputs].as_flattened());
        let vectors = LANES / S::F32_LANES;
        for vector in 0..vectors {
            let mut sums = [simd.splat_f32s(0.0); C];
            if let Some(start) = start {
                for c in 0..C {
                    sums[c] = S::as_simd_f32s(&start[column + c]).0[vector];
                }
            }
            for (i, input) in inputs.iter().enumerate() {
                let input = simd.splat_f32s(*input);
                for c in 0..C {
                    let weights = weights[(c * inputs.len() + i) * vectors + vector];
                    sums[c] = simd.add_f32s(sums[c], simd.mul_f32s(input, weights));
                }
            }
            for c in 0..C {
                S::as_mut_simd_f32s(&mut to.data[row * to.width + column + c]).0[vector] = sums[c];
            }
        }
    }
}

/// Four columns of a block of [`LANES`] rows of `width` numbers, from column `first` on.
fn transpose(block: &[f32], width: usize, first: usize, columns: &mut [Lane; 4]) {
    for k in (0..LANES).step_by(4) {
        let row = |r: usize| match block[(k + r) * width + first..] {
            [a, b, c, d, ..] => [a, b, c, d],
            _ => [0.0; 4], // there are four
        };
        let rows = [row(0), row(1), row(2), row(3)];
        for (i, column) in columns.iter_mut().enumerate() {
            column[k..k + 4].copy_from_slice(&[rows[0][i], rows[1][i], rows[2][i], rows[3][i]]);
        }
    }
}

/// `R` rows at once: each of `weights` is loaded once for all.
#[inline(always)]
fn product<S: Simd, const R: usize>(
    simd: S,
    from: &Rows,
    row: usize,
    weights: &[Lane],
    start: &Lane,
    to: &mut Rows,
    column: usize,
) {
    let width = from.width * LANES;
    let inputs = &from.data.as_flattened()[row * width..][..R * width];
    let (weights, _) = S::as_simd_f32s(weights.as_flattened());
    let (start, _) = S::as_simd_f32s(start);
    for vector in 0..start.len() {
        let mut sums = [start[vector]; R];
        for (i, weights) in weights.chunks_exact(start.len()).enumerate() {
            let weights = weights[vector];
            for r in 0..R {
                sums[r] = simd.add_f32s(sums[r], simd.mul_f32s(simd.splat_f32s(inputs[r * width + i]), weights));
            }
        }
        for r in 0..R {
            S::as_mut_simd_f32s(&mut to.data[(row + r) * to.width + column]).0[vector] = sums[r];
        }
    }
}

/// Adds Σ_b deltas_bo inputs_bi, over the first `n` rows in order of b, to `sums` [lanes of i, `outputs`].
#[inline(always)]
pub(crate) fn add_outer<S: Simd>(simd: S, sums: &mut [Lane], deltas: &Rows, outputs: usize, inputs: &Rows, n: usize) {
    for (column, sums) in sums.chunks_exact_mut(outputs).enumerate() {
        let (blocks, rest) = sums.as_chunks_mut::<8>();
        let done = blocks.len() * 8;
        for (block, sums) in blocks.iter_mut().enumerate() {
            outer(simd, sums, deltas, block * 8, inputs, column, n);
        }
        for (o, sum) in rest.iter_mut().enumerate() {
            outer(simd, std::array::from_mut(sum), deltas, done + o, inputs, column, n);
        }
    }
}

/// `R` outputs at once.
#[inline(always)]
fn outer<S: Simd, const R: usize>(
    simd: S,
    sums: &mut [Lane; R],
    deltas: &Rows,
    first: usize,
    inputs: &Rows,
    column: usize,
    n: usize,
) {
    let (inputs, width, stride) = (inputs.lanes(n), inputs.width, deltas.width * LANES);
    let deltas = deltas.lanes(n).as_flattened();
    for vector in 0..LANES / S::F32_LANES {
        let mut local = [simd.splat_f32s(0.0); R];
        for r in 0..R {
            local[r] = S::as_simd_f32s(&sums[r]).0[vector];
        }
        for b in 0..n {
            let inputs = S::as_simd_f32s(&inputs[b * width + column]).0[vector];
            let deltas = &deltas[b * stride + first..][..R];
            for r in 0..R {
                local[r] = simd.add_f32s(local[r], simd.mul_f32s(simd.splat_f32s(deltas[r]), inputs));
            }
        }
        for r in 0..R {
            S::as_mut_simd_f32s(&mut sums[r]).0[vector] = local[r];
        }
    }
}

/// Adds the first `n` rows to `sums`, in their order.
#[inline(always)]
pub(crate) fn add_rows(sums: &mut [Lane], rows: &Rows, n: usize) {
    for row in rows.lanes(n).chunks_exact(rows.width) {
        for (sums, row) in sums.iter_mut().zip(row) {
            for (sum, x) in sums.iter_mut().zip(row) {
                *sum += x;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, normal, stream};

    /// Products of `n` rows from 37 numbers to 21 and back.
    struct Products<'a> {
        matrix: &'a Matrix,
        from: &'a Rows,
        n: usize,
        start: &'a [Lane],
        to: &'a mut Rows,
        outer: &'a mut [Lane],
    }

    impl Kernel for Products<'_> {
        fn run<S: Simd>(self, simd: S) {
            self.matrix.apply(simd, self.from, self.n, Some(self.start), self.to);
            self.to.squash(self.n);
            add_outer(simd, self.outer, self.to, 21, self.from, self.n);
        }
    }

    fn numbers(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = stream(seed, Purpose::Weights);
        (0..n).map(|_| normal(&mut rng) as f32).collect()
    }

    /// What `run` computes, as bits.
    fn bits(n: usize, run: impl FnOnce(Products<'_>)) -> Vec<u32> {
        let mut matrix = Matrix::new(37, 21);
        matrix.load(0, &numbers(37 * 21, 1), 21);
        let (mut from, mut to) = (Rows::new(n, 37), Rows::new(n, 21));
        from.copy(&numbers(n * 37, 2), 37);
        let mut start = [[0.0; LANES]; 2];
        start.as_flattened_mut()[..21].copy_from_slice(&numbers(21, 3));
        let mut outer = vec![[0.5; LANES]; lanes(37) * 21];
        run(Products { matrix: &matrix, from: &from, n, start: &start, to: &mut to, outer: &mut outer });
        to.lanes(n).iter().chain(&outer).flatten().map(|x| x.to_bits()).collect()
    }

    /// The same by the definitions, one number after the other.
    fn naive(n: usize) -> Vec<u32> {
        let (matrix, rows, start) = (numbers(37 * 21, 1), numbers(n * 37, 2), numbers(21, 3));
        let mut to = vec![[0.0f32; 2 * LANES]; n];
        let mut outer = vec![[0.5f32; LANES]; lanes(37) * 21];
        for (row, to) in rows.chunks_exact(37).zip(&mut to) {
            for o in 0..21 {
                let sum = (0..37).fold(start[o], |sum, i| sum + row[i] * matrix[o * 37 + i]);
                to[o] = tanh(sum);
                for i in 0..37 {
                    outer[i / LANES * 21 + o][i % LANES] += to[o] * row[i];
                }
            }
        }
        to.as_flattened().iter().chain(outer.as_flattened()).map(|x| x.to_bits()).collect()
    }

    #[test]
    fn every_vector_unit_computes_the_same_bytes() {
        for n in [1, 4, 8, 13, 64] {
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
