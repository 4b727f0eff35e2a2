//! Registered keyframes -> their images as map files have them.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::mapper::keyframes::image_codec::{Content, SavedView};
use crate::mapper::keyframes::registered::RegisteredKeyframe;

/// Images of all keyframes, wherever they are, for files.
pub(crate) fn saved_views(registered: &BTreeMap<u32, RegisteredKeyframe>) -> Vec<SavedView> {
    let view = |(id, registered): (&u32, &RegisteredKeyframe)| {
        let in_memory = registered.home.is_here.then(|| Content::InMemory {
            image: Arc::clone(&registered.image),
            depth: Arc::clone(&registered.depth),
        });
        let saved = SavedView {
            keyframe_id: *id,
            is_held_out: registered.is_held_out,
            content: registered.home.copy.clone().or(in_memory)?,
        };
        if registered.home.regrown.is_none() {
            return Some(saved);
        }
        // The copy's depth is in a unit that the map has no longer.
        let size = (registered.image.width_px, registered.image.height_px);
        let (image, depth) = saved.unpacked(size).ok()?;
        let content = Content::InMemory {
            image: Arc::new(image),
            depth: registered.home.in_present_unit(depth),
        };
        Some(SavedView { content, ..saved })
    };
    registered.iter().filter_map(view).collect()
}
