//! Work on rows of numbers that is compiled for every kind of vector unit.

use std::ops::Range;

use pulp::{Arch, Scalar128b, Simd, WithSimd};

use crate::math::tanh;

/// Numbers that are computed side by side.
pub(crate) const LANES: usize = 16;

/// Numbers side by side.
pub(crate) type Lane = [f32; LANES];

/// Work that is compiled for every kind of vector unit.
pub(crate) trait Kernel {
    /// Runs with vectors of `simd`. Must be inlined.
    fn run<S: Simd>(self, simd: S);
}

struct Compiled<K>(K);

impl<K: Kernel> WithSimd for Compiled<K> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // Every x86-64 processor has vectors of four numbers.
        if S::F32_LANES == 1 { self.0.run(Scalar128b) } else { self.0.run(simd) }
    }
}

/// Runs `kernel` with the widest vectors that this processor has.
pub(crate) fn run(kernel: impl Kernel) {
    Arch::new().dispatch(Compiled(kernel));
}

/// Runs `kernel`, a part of another kernel, with the same vectors. The code is compiled once for each kind of vector unit, and not
/// once for each place that calls it.
#[inline(never)]
pub(crate) fn call<S: Simd>(simd: S, kernel: impl Kernel) {
    simd.vectorize(Compiled(kernel));
}

/// Number of lanes that hold `n` numbers.
pub(crate) const fn lanes(n: usize) -> usize {
    n.div_ceil(LANES)
}

/// A matrix whose rows are filled up with zeros to whole lanes.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    /// Lanes in a row.
    pub(crate) width: usize,
    pub(crate) data: Vec<Lane>,
}

/// The rows of a matrix from one of them on.
#[derive(Clone, Copy)]
pub(crate) struct RowsFrom<'a> {
    rows: &'a Rows,
    first: usize,
}

impl<'a> RowsFrom<'a> {
    /// Row `n` of these.
    pub(crate) fn row(&self, n: usize) -> &'a [f32] {
        self.rows.row(self.first + n)
    }
}

impl Rows {
    /// Zeros, `n` rows of `length` numbers.
    pub(crate) fn new(n: usize, length: usize) -> Self {
        Rows { width: lanes(length), data: vec![[0.0; LANES]; n * lanes(length)] }
    }

    /// Row `n`, with its padding.
    #[inline(always)]
    pub(crate) fn row(&self, n: usize) -> &[f32] {
        self.data[n * self.width..][..self.width].as_flattened()
    }

    /// Row `n` with its padding, to be changed.
    #[inline(always)]
    pub(crate) fn row_mut(&mut self, n: usize) -> &mut [f32] {
        self.data[n * self.width..][..self.width].as_flattened_mut()
    }

    /// The rows from `first` on.
    #[inline(always)]
    pub(crate) fn from(&self, first: usize) -> RowsFrom<'_> {
        RowsFrom { rows: self, first }
    }

    /// Copies `rows` of `length` numbers to the front of row `first` and those after it.
    pub(crate) fn copy(&mut self, first: usize, rows: &[f32], length: usize) {
        for (n, row) in rows.chunks_exact(length).enumerate() {
            self.row_mut(first + n)[..length].copy_from_slice(row);
        }
    }

    /// The first `n` rows.
    #[inline(always)]
    pub(crate) fn lanes(&self, n: usize) -> &[Lane] {
        &self.data[..n * self.width]
    }

    /// The first `n` rows, to be changed.
    #[inline(always)]
    pub(crate) fn lanes_mut(&mut self, n: usize) -> &mut [Lane] {
        &mut self.data[..n * self.width]
    }

    /// Replaces `rows` by their tanh.
    #[inline(always)]
    pub(crate) fn squash(&mut self, rows: Range<usize>) {
        for lane in &mut self.data[rows.start * self.width..rows.end * self.width] {
            for x in lane {
                *x = tanh(*x);
            }
        }
    }

    /// Multiplies the first `n` rows, derivatives with respect to a tanh, by 1 - tanh². `tanhs` are the results of the
    /// tanh.
    #[inline(always)]
    pub(crate) fn differentiate_tanh(&mut self, tanhs: &Rows, n: usize) {
        for (lane, tanhs) in self.lanes_mut(n).iter_mut().zip(tanhs.lanes(n)) {
            for (x, tanh) in lane.iter_mut().zip(tanhs) {
                *x *= 1.0 - tanh * tanh;
            }
        }
    }
}
