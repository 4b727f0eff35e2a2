//! rows: splats come, go and are copied; each attribute is a table with one row a splat.

use crate::splats::splats::Splats;

impl Splats {
    /// Adds the rows of `more` behind those that are there.
    pub fn extend(&mut self, more: &Self) {
        more.assert_consistent();
        if self.is_empty() {
            self.sh_degree = more.sh_degree;
        }
        assert_eq!(
            self.sh_degree, more.sh_degree,
            "all splats of an engine have one SH degree"
        );
        extend(&mut self.means, &more.means);
        extend(&mut self.log_scales, &more.log_scales);
        extend(&mut self.quats, &more.quats);
        extend(&mut self.opacity_logits, &more.opacity_logits);
        extend(&mut self.sh, &more.sh);
        extend(&mut self.anchors, &more.anchors);
    }

    /// Room for more rows included.
    pub fn held_bytes(&self) -> usize {
        let floats = 3 * self.means.capacity()
            + 3 * self.log_scales.capacity()
            + 4 * self.quats.capacity()
            + self.opacity_logits.capacity()
            + self.sh.capacity();
        4 * (floats + self.anchors.capacity())
    }

    /// Keeps row i when `keep[i]`, in order.
    pub fn retain(&mut self, keep: &[bool]) {
        let sh_stride = self.sh_stride();
        retain_rows(&mut self.means, 1, keep);
        retain_rows(&mut self.log_scales, 1, keep);
        retain_rows(&mut self.quats, 1, keep);
        retain_rows(&mut self.opacity_logits, 1, keep);
        retain_rows(&mut self.sh, sh_stride, keep);
        retain_rows(&mut self.anchors, 1, keep);
    }

    /// Overwrites row `to`, which may be the one behind the last, with row `from`.
    pub fn copy_row(&mut self, from: usize, to: usize) {
        let sh_stride = self.sh_stride();
        copy_row(&mut self.means, 1, from, to);
        copy_row(&mut self.log_scales, 1, from, to);
        copy_row(&mut self.quats, 1, from, to);
        copy_row(&mut self.opacity_logits, 1, from, to);
        copy_row(&mut self.sh, sh_stride, from, to);
        copy_row(&mut self.anchors, 1, from, to);
    }

    /// Our own mistake when it fails: readers of files check before.
    pub fn assert_consistent(&self) {
        let n = self.means.len();
        let lengths = [
            self.log_scales.len(),
            self.quats.len(),
            self.opacity_logits.len(),
            self.anchors.len(),
        ];
        assert_eq!(lengths, [n; 4], "all attributes of splats have one length");
        assert!(
            self.sh_degree <= 3,
            "SH degree {} is above 3",
            self.sh_degree
        );
        assert_eq!(
            self.sh.len(),
            n * self.sh_stride(),
            "SH has `sh_stride` numbers a splat"
        );
    }
}

fn extend<T: Copy>(values: &mut Vec<T>, more: &[T]) {
    make_room(values, more.len());
    values.extend_from_slice(more);
}

/// Room for `more` values, and for a quarter of all beyond: doubling would take twice the memory that a budget allows.
pub fn make_room<T>(values: &mut Vec<T>, more: usize) {
    if values.capacity() - values.len() < more {
        values.reserve_exact(more.max(values.len() / 4));
    }
}

/// Keeps row i of `stride` values when `keep[i]`.
pub fn retain_rows<T: Copy>(values: &mut Vec<T>, stride: usize, keep: &[bool]) {
    let mut end = 0;
    for (i, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
        values.copy_within(i * stride..(i + 1) * stride, end);
        end += stride;
    }
    values.truncate(end);
}

fn copy_row<T: Copy>(values: &mut Vec<T>, stride: usize, from: usize, to: usize) {
    let row = from * stride..(from + 1) * stride;
    if to * stride == values.len() {
        make_room(values, stride);
        values.extend_from_within(row);
    } else {
        values.copy_within(row, to * stride);
    }
}
