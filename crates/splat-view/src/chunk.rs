//! The splats that hang on one keyframe, in the form of the wire, and since when each is as it is.

use std::sync::OnceLock;

use crate::hash::Hash;
use crate::record::{self, RECORD_WORDS, n_sh_words, sh_words_of};
use splat_types::snapshot::Snapshot;

/// Of a message.
const MAX_BYTES: usize = 256 << 10;
const HEADER_BYTES: usize = 32;
const KIND: u8 = 1;
const BEGINS_ANEW: u16 = 1;

/// What a chunk is made from: a snapshot, which of its splats, and the harmonics that clients may have.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    pub snapshot: &'a Snapshot,
    /// The snapshot that the chunk was made from before; splats that are the same bit for bit in both keep their words.
    pub before: Option<&'a Snapshot>,
    /// Indices in the snapshot, ascending.
    pub ixs: &'a [usize],
    pub sh_degree: u8,
    /// Counts what clients were shown; grows with each update.
    pub version: u32,
}

/// Never changes: an update makes another one of it.
#[derive(Debug)]
pub struct Chunk {
    pub key: u32,
    pub origin: [f32; 3],
    pub sh_degree: u8,
    /// Who holds an older version drops all of it.
    began_at: u32,
    /// Of the newest change.
    pub version: u32,
    /// Ascending.
    ids: Vec<u32>,
    /// Record and harmonics of each.
    words: Vec<u32>,
    changed_at: Vec<u32>,
    /// Version, and id that is gone since.
    removed: Vec<(u32, u32)>,
    /// By the degree of harmonics that a client has.
    hashes: [OnceLock<Hash>; 4],
}

/// What a client lacks of a chunk.
#[derive(Debug)]
pub struct Update<'a> {
    chunk: &'a Chunk,
    degree: u8,
    epoch: u32,
    is_whole: bool,
    ixs: Vec<u32>,
    removed: Vec<u32>,
}

impl Chunk {
    /// A chunk that nobody holds yet, its origin amid its splats.
    pub fn anew(key: u32, source: &Source<'_>) -> Self {
        let means = &source.snapshot.splats.means;
        let n = source.ixs.len().max(1) as f64;
        let origin = [0, 1, 2].map(|k| {
            let sum: f64 = source.ixs.iter().map(|ix| f64::from(means[*ix][k])).sum();
            (sum / n) as f32
        });
        let mut chunk = Self {
            key,
            origin,
            sh_degree: source.sh_degree,
            began_at: source.version,
            version: source.version,
            ids: Vec::with_capacity(source.ixs.len()),
            words: Vec::new(),
            changed_at: vec![source.version; source.ixs.len()],
            removed: Vec::new(),
            hashes: Default::default(),
        };
        for ix in source.ixs {
            chunk.ids.push(source.snapshot.splat_ids[*ix]);
            chunk.push_words(source, *ix);
        }
        chunk
    }

    /// The chunk after an update; `None` where nothing that it shows has changed.
    pub fn next(&self, source: &Source<'_>) -> Option<Self> {
        let stride = self.stride();
        let mut next = Self {
            ids: Vec::with_capacity(source.ixs.len()),
            words: Vec::with_capacity(source.ixs.len() * stride),
            changed_at: Vec::with_capacity(source.ixs.len()),
            removed: self.removed.clone(),
            hashes: Default::default(),
            ..*self
        };
        let mut old = 0;
        for ix in source.ixs {
            let id = source.snapshot.splat_ids[*ix];
            while self.ids.get(old).is_some_and(|held| *held < id) {
                next.removed.push((source.version, self.ids[old]));
                old += 1;
            }
            let held = (self.ids.get(old) == Some(&id)).then_some(old);
            old += usize::from(held.is_some());
            next.ids.push(id);
            let since = next.push_splat(self, source, *ix, held);
            next.changed_at.push(since);
        }
        let gone = self.ids[old..].iter().map(|id| (source.version, *id));
        next.removed.extend(gone);
        let is_changed =
            next.removed.len() > self.removed.len() || next.changed_at.contains(&source.version);
        if !is_changed {
            return None;
        }
        next.version = source.version;
        // Who has been away for long gets the whole chunk, which is shorter by then.
        if next.removed.len() > next.ids.len().max(1024) {
            next.removed.clear();
            next.began_at = source.version;
        }
        Some(next)
    }

    /// Appends the words of splat `ix` of the source, `held` its index in the chunk before -> since when they are so.
    fn push_splat(
        &mut self,
        before: &Self,
        source: &Source<'_>,
        ix: usize,
        held: Option<usize>,
    ) -> u32 {
        let Some(held) = held else {
            self.push_words(source, ix);
            return source.version;
        };
        let stride = self.stride();
        let words = &before.words[held * stride..(held + 1) * stride];
        let at = self.words.len();
        if source.is_as_before(ix) {
            self.words.extend(words);
        } else {
            self.push_words(source, ix);
        }
        if self.words[at..] == *words {
            before.changed_at[held]
        } else {
            source.version
        }
    }

    fn push_words(&mut self, source: &Source<'_>, ix: usize) {
        let splats = &source.snapshot.splats;
        self.words.extend(record::record(splats, ix, self.origin));
        record::push_harmonics(splats, ix, self.sh_degree, &mut self.words);
    }

    fn stride(&self) -> usize {
        RECORD_WORDS + n_sh_words(self.sh_degree)
    }

    pub fn len(&self) -> usize {
        self.ids.len()
    }

    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// Of all that a client with harmonics up to `degree` holds of it.
    pub(crate) fn hash(&self, degree: u8) -> Hash {
        let degree = degree.min(self.sh_degree);
        *self.hashes[usize::from(degree)].get_or_init(|| {
            let n_words = RECORD_WORDS + n_sh_words(degree);
            let [x, y, z] = self.origin.map(f32::to_bits);
            let of_chunk = Hash::of(&[self.key, x, y, z].into_iter());
            let splats = self.ids.iter().zip(self.words.chunks_exact(self.stride()));
            let of_splat = |(id, words): (&u32, &[u32])| {
                Hash::of(&std::iter::once(*id).chain(words[..n_words].iter().copied()))
            };
            of_chunk + splats.map(of_splat).sum()
        })
    }

    /// What who holds `since` lacks; all of it for `None`.
    pub fn update(&self, since: Option<u32>, degree: u8, epoch: u32) -> Update<'_> {
        let since = since.filter(|since| *since >= self.began_at);
        let is_new = |at: &u32| since.is_none_or(|since| *at > since);
        let ixs = (0..self.ids.len() as u32).filter(|ix| is_new(&self.changed_at[*ix as usize]));
        let removed = self.removed.iter().filter(|(at, _)| is_new(at));
        Update {
            chunk: self,
            degree: degree.min(self.sh_degree),
            epoch,
            is_whole: since.is_none(),
            ixs: ixs.collect(),
            removed: match since {
                None => Vec::new(),
                Some(_) => removed.map(|(_, id)| *id).collect(),
            },
        }
    }
}

impl Source<'_> {
    fn is_as_before(&self, ix: usize) -> bool {
        let Some(before) = self.before else {
            return false;
        };
        let (new, old) = (&self.snapshot.splats, &before.splats);
        let id = self.snapshot.splat_ids[ix];
        // Few splats go, so that the place has moved a little at most.
        let Ok(held) = before.splat_ids.binary_search(&id) else {
            return false;
        };
        let stride = new.sh_stride();
        new.sh_degree == old.sh_degree
            && new.means[ix] == old.means[held]
            && new.quats[ix] == old.quats[held]
            && new.log_scales[ix] == old.log_scales[held]
            && new.opacity_logits[ix] == old.opacity_logits[held]
            && new.sh[ix * stride..(ix + 1) * stride] == old.sh[held * stride..(held + 1) * stride]
    }
}

impl Update<'_> {
    /// The messages, each made when it is asked for.
    pub fn messages(&self) -> impl Iterator<Item = Vec<u8>> + '_ {
        let of_splat = 4 * (1 + RECORD_WORDS + n_sh_words(self.degree));
        let most = (MAX_BYTES - HEADER_BYTES) / of_splat;
        let n_pieces = self.ixs.len().div_ceil(most).max(1);
        // Ids that are gone have less than a fourth of a splat's bytes, and there are no more of them than splats were.
        let most_removed = (MAX_BYTES - HEADER_BYTES) / 4;
        let n_removed = self.removed.len().div_ceil(most_removed);
        let is_nothing = !self.is_whole && self.ixs.is_empty();
        let goes = self
            .removed
            .chunks(most_removed)
            .take(n_removed)
            .map(|gone| self.message(&[], gone, false));
        let comes = (0..n_pieces)
            .filter(move |_| !is_nothing)
            .map(move |piece| {
                let from = piece * most;
                let to = (from + most).min(self.ixs.len());
                self.message(&self.ixs[from..to], &[], self.is_whole && piece == 0)
            });
        goes.chain(comes)
    }

    fn message(&self, ixs: &[u32], removed: &[u32], begins: bool) -> Vec<u8> {
        let chunk = self.chunk;
        let mut bytes = vec![KIND, self.degree];
        let mut put = |words: &[u8]| bytes.extend(words);
        put(&if begins { BEGINS_ANEW } else { 0 }.to_le_bytes());
        put(&chunk.key.to_le_bytes());
        put(&self.epoch.to_le_bytes());
        put(&(ixs.len() as u32).to_le_bytes());
        put(&(removed.len() as u32).to_le_bytes());
        chunk.origin.iter().for_each(|v| put(&v.to_le_bytes()));
        ixs.iter()
            .for_each(|ix| put(&chunk.ids[*ix as usize].to_le_bytes()));
        let mut put_words = |range: std::ops::Range<usize>| {
            for ix in ixs {
                let at = *ix as usize * chunk.stride();
                let words = &chunk.words[at + range.start..at + range.end];
                words.iter().for_each(|word| put(&word.to_le_bytes()));
            }
        };
        put_words(0..RECORD_WORDS);
        for degree in 1..=self.degree {
            let of = sh_words_of(degree);
            put_words(RECORD_WORDS + of.start..RECORD_WORDS + of.end);
        }
        removed.iter().for_each(|id| put(&id.to_le_bytes()));
        bytes
    }
}
