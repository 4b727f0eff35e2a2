//! A map that stays -> the messages of a viewer's connection in one piece, for a page that has them in itself.

use crate::messages;
use crate::sync::{ClientState, Hello};
use crate::view_map::{Builder, Published};

/// Degrees of harmonics, best first: one with fewer bytes a splat is taken where the map is large.
const DEGREES: [u8; 4] = [3, 2, 1, 0];

/// Frames of u32 length (little endian), u8 kind (0 text, 1 binary) and bytes; `None` where the map has more than `max_bytes` in its most compact form.
pub fn frames(published: &Published, title: &str, max_bytes: usize) -> Option<Vec<u8>> {
    DEGREES.into_iter().find_map(|sh_degree| {
        let n_words = 1 + crate::record::RECORD_WORDS + crate::record::n_sh_words(sh_degree);
        let n_bytes = 4 * n_words * published.snapshot.splats.len();
        (n_bytes <= max_bytes).then(|| of_degree(published, title, sh_degree))
    })
}

fn of_degree(published: &Published, title: &str, sh_degree: u8) -> Vec<u8> {
    let map = Builder::new(sh_degree).update(published);
    let hello = Hello {
        protocol: messages::PROTOCOL,
        max_splats: usize::MAX,
        sh_degree,
        map_id: String::new(),
        epoch: 0,
        chunks: Vec::new(),
    };
    let mut bytes = Vec::new();
    let mut put = |kind: u8, message: &[u8]| {
        bytes.extend((message.len() as u32).to_le_bytes());
        bytes.push(kind);
        bytes.extend(message);
    };
    put(0, messages::welcome("map", title).as_bytes());
    if let Some(plan) = ClientState::new(&hello, &map).plan(&map) {
        plan.before.iter().for_each(|text| put(0, text.as_bytes()));
        for (chunk, _) in &plan.chunks {
            let update = chunk.update(None, sh_degree, map.epoch);
            update.messages().for_each(|message| put(1, &message));
        }
        put(0, plan.after.as_bytes());
    }
    bytes
}
