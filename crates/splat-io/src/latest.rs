//! One value that a thread replaces and others read: the newest counts, older ones are gone.

use std::sync::{Arc, Mutex, PoisonError};

/// Readers get the newest value; nobody waits for another.
#[derive(Debug, Default)]
pub struct Latest<T> {
    value: Mutex<Arc<T>>,
}

impl<T> Latest<T> {
    pub fn new(value: T) -> Self {
        Self {
            value: Mutex::new(Arc::new(value)),
        }
    }

    pub fn get(&self) -> Arc<T> {
        // A panic in the middle of a change leaves a value that can be shown.
        Arc::clone(&self.value.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub fn set(&self, value: T) {
        *self.value.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(value);
    }

    /// Replaces a part of the value; who has the old one keeps it.
    pub fn update(&self, change: impl FnOnce(&mut T))
    where
        T: Clone,
    {
        let mut value = self.value.lock().unwrap_or_else(PoisonError::into_inner);
        change(Arc::make_mut(&mut value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readers_get_the_newest_value_and_keep_the_one_they_have() {
        let cell = Latest::new(1);
        let first = cell.get();
        cell.set(2);
        assert_eq!((*first, *cell.get()), (1, 2));
        let second = cell.get();
        cell.update(|value| *value += 3);
        assert_eq!((*second, *cell.get()), (2, 5));
    }
}
