//! Memory of images that nobody looks at any more, for the next ones: a camera's frames then cost no allocation.

use std::sync::Arc;

use crate::limits::empty;
use splat_types::image::RgbImage;

/// Images that may be on their way at once: the queues hold six, select and track a few.
const MAX_LENT: usize = 12;
/// Images larger than this are few, and two dozen of them would be too much to keep.
const MAX_LENT_BYTES: usize = 4 << 20;
/// One as it is decoded, and of the size that frames have those on the way through scaling and undistortion.
const MAX_SPARE: usize = 4;
const MAX_SPARE_BYTES: usize = 32 << 20;

#[derive(Debug, Default)]
pub struct Pool {
    /// Handed out, and free again once the pool alone holds them. Those that became keyframes never are.
    lent: Vec<Arc<RgbImage>>,
    oldest: usize,
    spare: Vec<RgbImage>,
}

impl Pool {
    /// An image to decode into, of the largest memory there is; its size and content are anything.
    pub fn spare(&mut self) -> RgbImage {
        let memory = |ix: &usize| self.spare[*ix].pixels.capacity();
        let largest = (0..self.spare.len()).max_by_key(memory);
        largest.map_or_else(empty, |ix| self.spare.swap_remove(ix))
    }

    /// An image to write so many bytes into. It has not much more memory than that: frames keep it for as long as they
    /// are kept.
    pub fn spare_of(&mut self, n_bytes: usize) -> RgbImage {
        let fits = |p: &RgbImage| (n_bytes..=n_bytes + n_bytes / 4).contains(&p.pixels.capacity());
        let fitting = self.spare.iter().position(fits);
        fitting.map_or_else(empty, |ix| self.spare.swap_remove(ix))
    }

    pub fn take_back(&mut self, image: RgbImage) {
        if self.spare.len() < MAX_SPARE && image.pixels.capacity() <= MAX_SPARE_BYTES {
            self.spare.push(image);
        }
    }

    /// The image as frames carry it.
    pub fn lend(&mut self, image: RgbImage) -> Arc<RgbImage> {
        if image.pixels.len() > MAX_LENT_BYTES {
            return Arc::new(image);
        }
        if let Some(ix) = self.lent.iter_mut().position(|p| Arc::get_mut(p).is_some()) {
            let free = Arc::get_mut(&mut self.lent[ix]).expect("nobody else holds it");
            let old = std::mem::replace(free, image);
            self.take_back(old);
            return Arc::clone(&self.lent[ix]);
        }
        let lent = Arc::new(image);
        if self.lent.len() < MAX_LENT {
            self.lent.push(Arc::clone(&lent));
        } else {
            self.lent[self.oldest] = Arc::clone(&lent);
            self.oldest = (self.oldest + 1) % MAX_LENT;
        }
        lent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn test_image(value: u8) -> RgbImage {
        RgbImage {
            width_px: 2,
            height_px: 1,
            pixels: vec![value; 6],
        }
    }

    #[test]
    fn a_image_that_is_held_never_changes_and_a_free_one_is_used_again() {
        let mut pool = Pool::default();
        let held = pool.lend(test_image(1));
        let freed = pool.lend(test_image(2));
        let address = Arc::as_ptr(&freed);
        drop(freed);
        let third = pool.lend(test_image(3));
        assert_eq!((held.pixels[0], third.pixels[0]), (1, 3));
        assert_eq!(Arc::as_ptr(&third), address);
        assert_eq!(pool.spare().pixels, vec![2; 6]);
    }

    #[test]
    fn a_small_image_does_not_sit_in_the_memory_of_a_large_one() {
        let mut pool = Pool::default();
        let of = |n_bytes| RgbImage {
            pixels: Vec::with_capacity(n_bytes),
            ..test_image(0)
        };
        for n_bytes in [400, 110, 100] {
            pool.take_back(of(n_bytes));
        }
        assert_eq!(pool.spare_of(100).pixels.capacity(), 110);
        assert_eq!(pool.spare_of(99).pixels.capacity(), 100);
        assert_eq!(pool.spare_of(100).pixels.capacity(), 0);
        assert_eq!(pool.spare().pixels.capacity(), 400);
    }

    #[test]
    fn the_pool_forgets_images_that_are_kept_for_ever() {
        let mut pool = Pool::default();
        let kept: Vec<_> = (0..100).map(|ix| pool.lend(test_image(ix))).collect();
        assert_eq!(pool.lent.len(), MAX_LENT);
        assert!(
            kept.iter()
                .enumerate()
                .all(|(ix, p)| p.pixels[0] == ix as u8)
        );
    }
}
