//! Splats of a part of the map, with their update counts <-> bytes. Whatever comes from a file may be arbitrary.

use byteorder::{LittleEndian, ReadBytesExt};

use splat_types::splats::layout;
use splat_types::splats::splats::Splats;

pub(crate) fn parse_degree(word: u32) -> Result<u8, String> {
    u8::try_from(word)
        .ok()
        .filter(|degree| *degree <= layout::MAX_SH_DEGREE)
        .ok_or_else(|| format!("SH degree {word}, expected 0 to {}", layout::MAX_SH_DEGREE))
}

pub(crate) fn parse_run(sh_degree: u8, run: &[u8]) -> Result<Splats, String> {
    let mut splats = Splats {
        sh_degree,
        ..Splats::default()
    };
    layout::decode(run, &mut splats)
        .ok_or_else(|| format!("{} bytes are no whole number of splats", run.len()))?;
    layout::fault(&splats).map_or(Ok(splats), Err)
}

/// Of the splats in their order.
pub(crate) fn age_bytes(update_counts: &[u16]) -> Vec<u8> {
    update_counts
        .iter()
        .flat_map(|age| age.to_le_bytes())
        .collect()
}

pub(crate) fn parse_update_counts(content: &[u8]) -> Result<Vec<u16>, String> {
    let (update_counts, rest) = content.as_chunks::<2>();
    if !rest.is_empty() {
        return Err(format!(
            "{} bytes are no whole number of update counts",
            content.len()
        ));
    }
    Ok(update_counts
        .iter()
        .map(|age| u16::from_le_bytes(*age))
        .collect())
}

/// Splats of a part of the map, with their update counts.
pub(crate) fn region_bytes(splats: &Splats, update_counts: &[u16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(region_len(splats.len(), splats.sh_degree));
    bytes.extend_from_slice(&u32::from(splats.sh_degree).to_le_bytes());
    bytes.extend_from_slice(&(splats.len() as u32).to_le_bytes());
    let age = |ix: usize| update_counts.get(ix).copied().unwrap_or(0);
    bytes.extend((0..splats.len()).flat_map(|ix| age(ix).to_le_bytes()));
    layout::encode(splats, 0..splats.len(), &mut bytes);
    bytes
}

pub(crate) fn region_len(n: usize, sh_degree: u8) -> usize {
    8 + n * (2 + layout::bytes_per_splat(sh_degree))
}

/// Takes one part off the front.
pub(crate) fn take_region(rest: &mut &[u8]) -> Result<(Splats, Vec<u16>), String> {
    let mut word = || rest.read_u32::<LittleEndian>().map_err(|e| e.to_string());
    let (sh_degree, n) = (word()?, word()? as usize);
    let sh_degree = parse_degree(sh_degree)?;
    let (update_counts, after) = rest
        .split_at_checked(2 * n)
        .ok_or_else(|| format!("{n} splats are announced, the section ends"))?;
    let (run, after) = after
        .split_at_checked(n * layout::bytes_per_splat(sh_degree))
        .ok_or_else(|| format!("{n} splats are announced, the section ends"))?;
    *rest = after;
    Ok((
        parse_run(sh_degree, run)?,
        parse_update_counts(update_counts)?,
    ))
}
