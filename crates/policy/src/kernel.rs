//! Vectorised functions on rows of numbers, compiled for several instruction sets.

use std::ops::Range;

use pulp::{Arch, Scalar128b, Simd, WithSimd};

use crate::math::tanh;

/// Number of f32 in a [`Lane`], the unit in which rows are stored. It is a multiple of every vector width.
pub(crate) const LANES: usize = 16;

/// A group of successive numbers of a row that are computed together.
pub(crate) type Lane = [f32; LANES];

/// A computation that is compiled for each of several instruction sets; [`run`] chooses among them at run time.
pub(crate) trait Kernel {
    /// Runs the computation with the vector instructions of `simd`. Must be `#[inline(always)]`.
    fn run<S: Simd>(self, simd: S);
}

struct Compiled<K>(K);

impl<K: Kernel> WithSimd for Compiled<K> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // On a processor without wide vectors, pulp would compute single numbers. Vectors of four numbers are faster,
        // and every x86-64 processor has them.
        if S::F32_LANES == 1 { self.0.run(Scalar128b) } else { self.0.run(simd) }
    }
}

/// Runs `kernel` with the widest vectors of this processor.
pub(crate) fn run(kernel: impl Kernel) {
    Arch::new().dispatch(Compiled(kernel));
}

/// Runs `kernel` from within another kernel, with the same instruction set. The function is not inlined, so that the
/// code is compiled only once for each instruction set instead of at every call.
#[inline(never)]
pub(crate) fn call<S: Simd>(simd: S, kernel: impl Kernel) {
    simd.vectorize(Compiled(kernel));
}

/// Returns the number of lanes that hold `n` numbers, rounded up.
pub(crate) const fn lanes(n: usize) -> usize {
    n.div_ceil(LANES)
}

/// A row-major matrix whose rows are padded with zeros to a whole number of lanes.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    /// Number of lanes in a row.
    pub(crate) width: usize,
    pub(crate) data: Vec<Lane>,
}

/// A view of the rows of a matrix that starts at row `first`.
#[derive(Clone, Copy)]
pub(crate) struct RowsFrom<'a> {
    rows: &'a Rows,
    first: usize,
}

impl<'a> RowsFrom<'a> {
    /// Returns row `n` of the view, with its padding.
    pub(crate) fn row(&self, n: usize) -> &'a [f32] {
        self.rows.row(self.first + n)
    }
}

impl Rows {
    /// Creates a matrix of zeros with `n` rows of `length` numbers.
    pub(crate) fn new(n: usize, length: usize) -> Self {
        Rows { width: lanes(length), data: vec![[0.0; LANES]; n * lanes(length)] }
    }

    /// Returns row `n`, with its padding.
    #[inline(always)]
    pub(crate) fn row(&self, n: usize) -> &[f32] {
        self.data[n * self.width..][..self.width].as_flattened()
    }

    /// Returns row `n` for writing, with its padding.
    #[inline(always)]
    pub(crate) fn row_mut(&mut self, n: usize) -> &mut [f32] {
        self.data[n * self.width..][..self.width].as_flattened_mut()
    }

    /// Returns a view that starts at row `first`.
    #[inline(always)]
    pub(crate) fn from(&self, first: usize) -> RowsFrom<'_> {
        RowsFrom { rows: self, first }
    }

    /// Copies `rows`, each of `length` numbers, to the beginnings of the matrix's rows `first`, `first` + 1, ….
    pub(crate) fn copy(&mut self, first: usize, rows: &[f32], length: usize) {
        for (n, row) in rows.chunks_exact(length).enumerate() {
            self.row_mut(first + n)[..length].copy_from_slice(row);
        }
    }

    /// Returns the lanes of the first `n` rows.
    #[inline(always)]
    pub(crate) fn lanes(&self, n: usize) -> &[Lane] {
        &self.data[..n * self.width]
    }

    /// Returns the lanes of the first `n` rows for writing.
    #[inline(always)]
    pub(crate) fn lanes_mut(&mut self, n: usize) -> &mut [Lane] {
        &mut self.data[..n * self.width]
    }

    /// Applies tanh to every number of `rows`.
    #[inline(always)]
    pub(crate) fn squash(&mut self, rows: Range<usize>) {
        for lane in &mut self.data[rows.start * self.width..rows.end * self.width] {
            for x in lane {
                *x = tanh(*x);
            }
        }
    }

    /// Multiplies the first `n` rows by 1 - tanh², the derivative of tanh. Turns derivatives with respect to the
    /// outputs of tanh, `tanhs`, into derivatives with respect to its inputs.
    #[inline(always)]
    pub(crate) fn differentiate_tanh(&mut self, tanhs: &Rows, n: usize) {
        for (lane, tanhs) in self.lanes_mut(n).iter_mut().zip(tanhs.lanes(n)) {
            for (x, tanh) in lane.iter_mut().zip(tanhs) {
                *x *= 1.0 - tanh * tanh;
            }
        }
    }
}
