//! Numbers that splats keep as long as they live, in the engine's order: ascending, since it appends behind.

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct SplatIds {
    ids: Vec<u32>,
    next: u32,
}

impl SplatIds {
    /// The engine holds `n` splats: those behind the ones that have a number are new. Returns whether all got new
    /// numbers, because there are no more.
    pub(crate) fn grow_to(&mut self, n: usize) -> bool {
        assert!(n >= self.ids.len(), "splats go by `retain`");
        let n_new = u32::try_from(n - self.ids.len()).unwrap_or(u32::MAX);
        let Some(end) = self.next.checked_add(n_new) else {
            self.ids = (0..n as u32).collect();
            self.next = n as u32;
            return true;
        };
        self.ids.extend(self.next..end);
        self.next = end;
        false
    }

    pub(crate) fn retain(&mut self, keep: &[bool]) {
        let mut keep = keep.iter();
        self.ids.retain(|_| keep.next().copied().unwrap_or(false));
    }

    /// Numbers as they were at an earlier moment; none that were given since is given again.
    pub(crate) fn restore(&mut self, ids: &[u32]) {
        self.ids = ids.to_vec();
        let behind = ids.last().map_or(0, |last| last.saturating_add(1));
        self.next = self.next.max(behind);
    }

    pub(crate) fn all(&self) -> &[u32] {
        &self.ids
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_stays_with_its_splat_and_never_comes_back() {
        let mut ids = SplatIds::default();
        assert!(!ids.grow_to(4));
        ids.retain(&[true, false, true, false]);
        assert!(!ids.grow_to(4));
        assert_eq!(ids.all(), [0, 2, 4, 5]);
        ids.next = u32::MAX - 1;
        assert!(ids.grow_to(7) && ids.all() == [0, 1, 2, 3, 4, 5, 6]);
    }
}
