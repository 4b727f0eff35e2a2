//! The segments before the first scan of a JPEG -> the size, the planes and the tables that its scan needs.
//!
//! Source: ITU-T T.81, annex B. Reports baseline images, as cameras send them, from those of other kinds.

use std::sync::LazyLock;

use crate::jpeg::huffman::Table;
use crate::jpeg::{idct, tables};

/// Of a plane against the image: whole or half, across and down.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sampling {
    Grey,
    Full,
    HalfAcross,
    Half,
}

/// What the header says of one component; `sides`: blocks across and down, four bits each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Component {
    id: u8,
    sides: u8,
    pub(crate) quantiser_ix: usize,
    pub(crate) dc_ix: usize,
    pub(crate) ac_ix: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) width_px: u32,
    pub(crate) height_px: u32,
    pub(crate) sampling: Sampling,
    /// The first `n_planes` of them.
    pub(crate) components: [Component; 3],
    /// Units between two restarts; 0: none.
    pub(crate) restart_interval: usize,
    /// Where the scan's data begin.
    pub(crate) data_at: usize,
}

/// What the segments define, by id; the last definition stands.
#[derive(Debug, Default)]
pub(crate) struct Tables {
    pub(crate) quantisers: [Quantiser; 4],
    pub(crate) dc: [Codes; 4],
    pub(crate) ac: [Codes; 4],
}

#[derive(Debug)]
pub(crate) struct Quantiser {
    /// By place on the way through the block, with the transform's scales.
    pub(crate) factors: [f32; 64],
    is_set: bool,
}

impl Default for Quantiser {
    fn default() -> Self {
        Self {
            factors: [0.0; 64],
            is_set: false,
        }
    }
}

#[derive(Debug, Default)]
pub(crate) struct Codes {
    pub(crate) table: Table,
    is_set: bool,
}

/// By place on the way through the block.
static SCALES: LazyLock<[f32; 64]> = LazyLock::new(|| {
    std::array::from_fn(|ix| {
        let (across, down) = tables::frequency(ix);
        idct::scale(across, down)
    })
});

impl Sampling {
    pub(crate) fn n_planes(self) -> usize {
        if self == Self::Grey { 1 } else { 3 }
    }

    /// Blocks of the first plane in one unit of the scan, across and down. The others have one.
    pub(crate) fn blocks(self) -> (usize, usize) {
        match self {
            Self::Grey | Self::Full => (1, 1),
            Self::HalfAcross => (2, 1),
            Self::Half => (2, 2),
        }
    }

    fn of(components: &[Component]) -> Option<Self> {
        match *components {
            // The scan of a single plane is in the order of its blocks, whatever its sides.
            [_] => Some(Self::Grey),
            [luma, blue, red] if [blue.sides, red.sides] == [0x11; 2] => match luma.sides {
                0x11 => Some(Self::Full),
                0x21 => Some(Self::HalfAcross),
                0x22 => Some(Self::Half),
                _ => None,
            },
            _ => None,
        }
    }
}

impl Header {
    /// `None`: it is of another kind, or broken; a decoder of all kinds can determine.
    pub(crate) fn read(bytes: &[u8], tables: &mut Tables) -> Option<Self> {
        tables.forget();
        let mut at = 2;
        let mut found = None;
        let mut restart_interval = 0;
        loop {
            while bytes.get(at..at + 2)? == [0xff, 0xff] {
                at += 1;
            }
            let &[0xff, marker, upper, lower] = bytes.get(at..at + 4)? else {
                return None;
            };
            let end = at + 2 + usize::from(u16::from_be_bytes([upper, lower]));
            let body = bytes.get(at + 4..end)?;
            match marker {
                // Baseline, and the same with more tables.
                0xc0 | 0xc1 => found = Some(size_and_planes(body)?),
                0xc4 => tables.read_codes(body)?,
                0xdb => tables.read_quantisers(body)?,
                0xdd => restart_interval = usize::from(u16::from_be_bytes(*body.first_chunk()?)),
                // Adobe's: its last byte says whether the colours are YCbCr.
                0xee if body.starts_with(b"Adobe") && body.get(11) != Some(&1) => return None,
                0xe0..=0xef | 0xfe => {}
                0xda => {
                    let (width_px, height_px, mut components, n_planes) = found?;
                    let components_of_scan = &mut components[..n_planes];
                    read_scan(body, components_of_scan)?;
                    let sampling = Sampling::of(components_of_scan)?;
                    let is_complete = components_of_scan.iter().all(|c| tables.has(c));
                    return is_complete.then_some(Self {
                        width_px,
                        height_px,
                        sampling,
                        components,
                        restart_interval,
                        data_at: end,
                    });
                }
                _ => return None,
            }
            at = end;
        }
    }
}

fn size_and_planes(body: &[u8]) -> Option<(u32, u32, [Component; 3], usize)> {
    let (&[8, h0, h1, w0, w1, n_planes], rest) = body.split_first_chunk()? else {
        return None;
    };
    let n_planes = usize::from(n_planes);
    let (parts, []) = rest.as_chunks::<3>() else {
        return None;
    };
    if parts.len() != n_planes || ![1, 3].contains(&n_planes) {
        return None;
    }
    let mut components = [Component::default(); 3];
    for (component, &[id, sides, quantiser]) in components.iter_mut().zip(parts) {
        component.id = id;
        component.sides = sides;
        component.quantiser_ix = usize::from(quantiser);
    }
    // Some files name their planes instead of reporting their colours.
    if components.map(|c| c.id) == *b"RGB" {
        return None;
    }
    let (height_px, width_px) = (u16::from_be_bytes([h0, h1]), u16::from_be_bytes([w0, w1]));
    Some((width_px.into(), height_px.into(), components, n_planes))
}

/// All planes in one scan, of all frequencies and bits.
fn read_scan(body: &[u8], components: &mut [Component]) -> Option<()> {
    let (&n_planes, rest) = body.split_first()?;
    let n_planes = usize::from(n_planes);
    if n_planes != components.len() || rest.get(2 * n_planes..)? != [0, 63, 0] {
        return None;
    }
    for (component, &[id, codes]) in components.iter_mut().zip(rest.as_chunks::<2>().0) {
        if id != component.id {
            return None;
        }
        component.dc_ix = usize::from(codes >> 4);
        component.ac_ix = usize::from(codes & 15);
    }
    Some(())
}

impl Tables {
    /// An image uses what it defines itself. Codes that a camera left out were put back before (`Jpeg`).
    fn forget(&mut self) {
        for quantiser in &mut self.quantisers {
            quantiser.is_set = false;
        }
        for codes in self.dc.iter_mut().chain(&mut self.ac) {
            codes.is_set = false;
        }
    }

    fn has(&self, component: &Component) -> bool {
        let is_set = |codes: &[Codes; 4], ix: usize| codes.get(ix).is_some_and(|c| c.is_set);
        let quantiser = self.quantisers.get(component.quantiser_ix);
        quantiser.is_some_and(|q| q.is_set)
            && is_set(&self.dc, component.dc_ix)
            && is_set(&self.ac, component.ac_ix)
    }

    fn read_codes(&mut self, mut body: &[u8]) -> Option<()> {
        while let Some((&id, rest)) = body.split_first() {
            let (n_codes, rest) = rest.split_first_chunk::<16>()?;
            let n_symbols = n_codes.iter().map(|&n| usize::from(n)).sum();
            let (symbols, rest) = rest.split_at_checked(n_symbols)?;
            let of_class = match id >> 4 {
                0 => &mut self.dc,
                1 => &mut self.ac,
                _ => return None,
            };
            let codes = of_class.get_mut(usize::from(id & 15))?;
            codes.table.set(n_codes, symbols)?;
            codes.is_set = true;
            body = rest;
        }
        Some(())
    }

    fn read_quantisers(&mut self, mut body: &[u8]) -> Option<()> {
        while let Some((&id, rest)) = body.split_first() {
            let (levels, rest) = rest.split_at_checked(if id >> 4 == 0 { 64 } else { 128 })?;
            let level = |ix: usize| match id >> 4 {
                0 => f32::from(levels[ix]),
                _ => f32::from(u16::from_be_bytes([levels[2 * ix], levels[2 * ix + 1]])),
            };
            let quantiser = self.quantisers.get_mut(usize::from(id & 15))?;
            quantiser.is_set = true;
            for (ix, factor) in quantiser.factors.iter_mut().enumerate() {
                *factor = level(ix) * SCALES[ix];
            }
            body = rest;
        }
        Some(())
    }
}
