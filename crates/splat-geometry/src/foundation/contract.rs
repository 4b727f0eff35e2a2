//! Inputs and outputs of a network, beside its description -> where each output stands, or what is wrong with it.

use crate::foundation::sidecar::Sidecar;
use crate::inference::Port;

pub const INPUT: &str = "images";

/// Where the outputs stand among those of the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slots {
    pub pose_enc: usize,
    pub depth: usize,
    pub depth_conf: usize,
}

/// A side as the contract has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    Frames,
    Fixed(i64),
    /// Any length.
    Free,
}

/// All that is wrong, in plain words, where the network is not of this contract.
pub fn places(inputs: &[Port], outputs: &[Port], sidecar: &Sidecar) -> Result<Slots, Vec<String>> {
    let (h, w) = (i64::from(sidecar.height), i64::from(sidecar.width));
    let mut faults = Vec::new();
    let images = [Side::Frames, Side::Fixed(3), Side::Fixed(h), Side::Fixed(w)];
    match inputs {
        [input] if input.name == INPUT => faults.extend(fault(input, &images, sidecar)),
        _ => faults.push(format!(
            "inputs are [{}], expected one, {INPUT} f32 [S, 3, {h}, {w}]",
            listed(inputs)
        )),
    }
    let map = [Side::Frames, Side::Fixed(h), Side::Fixed(w)];
    let mut place = |name: &str, sides: &[Side], is_needed: bool| {
        let at = outputs.iter().position(|port| port.name == name);
        match at {
            Some(at) => faults.extend(fault(&outputs[at], sides, sidecar)),
            None if is_needed => {
                faults.push(format!("no output {name} among [{}]", listed(outputs)));
            }
            None => {}
        }
        at
    };
    let pose_enc = place("pose_enc", &[Side::Frames, Side::Fixed(9)], true);
    let depth = place("depth", &map, true);
    let depth_conf = place("depth_conf", &map, true);
    let points = [map[0], map[1], map[2], Side::Fixed(3)];
    place("world_points", &points, false);
    place("world_points_conf", &map, false);
    place("frame_desc", &[Side::Frames, Side::Free], false);
    match (pose_enc, depth, depth_conf) {
        (Some(pose_enc), Some(depth), Some(depth_conf)) if faults.is_empty() => Ok(Slots {
            pose_enc,
            depth,
            depth_conf,
        }),
        _ => Err(faults),
    }
}

fn fault(port: &Port, expected: &[Side], sidecar: &Sidecar) -> Option<String> {
    let fits = |(found, side): (&i64, &Side)| match side {
        // A free side may still turn out wrong; the answer's own shape is looked at, too.
        _ if *found < 0 => true,
        Side::Fixed(side) => found == side,
        Side::Frames => *found == sidecar.s_min as i64 && *found == sidecar.s_max as i64,
        Side::Free => true,
    };
    let is_right = port.element == "f32"
        && port.shape.len() == expected.len()
        && port.shape.iter().zip(expected).all(fits);
    (!is_right).then(|| {
        let sides: Vec<String> = expected.iter().map(|side| side.to_string()).collect();
        format!(
            "{port}, where the description has f32 [{}] with S from {} to {}",
            sides.join(", "),
            sidecar.s_min,
            sidecar.s_max
        )
    })
}

fn listed(ports: &[Port]) -> String {
    let all: Vec<String> = ports.iter().map(ToString::to_string).collect();
    all.join(", ")
}

impl std::fmt::Display for Side {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Frames => f.write_str("S"),
            Self::Fixed(side) => write!(f, "{side}"),
            Self::Free => f.write_str("any"),
        }
    }
}
