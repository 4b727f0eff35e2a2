//! A scene: painted solids, found fast along rays, under light that was computed once.
//!
//! `props.rs` puts things in place; a `Scene` is what the camera sees.

use glam::{DVec3, Vec3, Vec3A};
use rayon::prelude::*;

use crate::geometry::Ray;
use crate::light::{Light, backdrop};
use crate::noise::hash;
use crate::paint::{Rgb, Spot};
use crate::props::Props;
use crate::solid::Solid;

/// Where a ray ends.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    pub(crate) distance: f64,
    pub(crate) solid_ix: usize,
    pub(crate) face: u8,
}

#[derive(Debug)]
pub(crate) struct Scene {
    pub(crate) solids: Vec<Solid>,
    pub(crate) light: Light,
    tree: Vec<Node>,
    order: Vec<u32>,
}

/// Inner nodes have `count` 0 and their children at `first` and `first + 1`; leaves name a range of `order`.
#[derive(Debug, Clone, Copy)]
struct Node {
    low: Vec3A,
    high: Vec3A,
    first: u32,
    count: u32,
}

/// A leaf this small is cheaper to test than to split.
const MAX_LEAF: usize = 2;

/// One entry a level; a tree of a few thousand solids is some 20 levels deep.
const MAX_STACK: usize = 96;

impl Scene {
    /// Faces have no light yet: `lighting::lit` gives it to them.
    pub(crate) fn unlit(props: Props, light: Light) -> Self {
        let mut solids = props.solids;
        solids
            .par_iter_mut()
            .for_each(|solid| solid.mean = solid.mean_colour());
        let boxes: Vec<(DVec3, DVec3)> = solids.iter().map(|solid| solid.placed.bounds()).collect();
        let mut order: Vec<u32> = (0..solids.len() as u32).collect();
        let mut tree = vec![Node {
            low: Vec3A::ZERO,
            high: Vec3A::ZERO,
            first: 0,
            count: 0,
        }];
        split(&mut tree, 0, &mut order, 0, &boxes);
        Self {
            solids,
            light,
            tree,
            order,
        }
    }

    pub(crate) fn meet(&self, ray: &Ray, farthest: f64) -> Option<Hit> {
        let mut nearest = None;
        let mut limit = farthest;
        self.walk(
            ray,
            |solid_ix, limit_so_far| {
                if let Some((distance, face)) = self.solids[solid_ix]
                    .placed
                    .meet(ray, limit_so_far.min(limit))
                {
                    limit = distance;
                    nearest = Some(Hit {
                        distance,
                        solid_ix,
                        face,
                    });
                }
                limit
            },
            farthest,
        );
        nearest
    }

    /// Whether anything that is not a lamp itself lies on the ray before `farthest`.
    pub(crate) fn is_covered(&self, ray: &Ray, farthest: f64) -> bool {
        let mut covered = false;
        self.walk(
            ray,
            |solid_ix, limit| {
                let solid = &self.solids[solid_ix];
                covered =
                    covered || (!solid.paint.glows() && solid.placed.meet(ray, limit).is_some());
                if covered { 0.0 } else { limit }
            },
            farthest,
        );
        covered
    }

    /// Visits the solids whose boxes the ray crosses, near ones first; `visit` answers how far to look on.
    fn walk(&self, ray: &Ray, mut visit: impl FnMut(usize, f64) -> f64, farthest: f64) {
        // Boxes are tested in f32 and a little too large, so that nothing is missed; solids are met in f64.
        let origin = ray.origin.as_vec3a();
        let inverse = ray.direction.as_vec3a().recip();
        let mut limit = farthest;
        let mut stack = [(0u32, 0.0f32); MAX_STACK];
        let mut height = 0;
        let root = &self.tree[0];
        if let Some(enter) = enters(root, origin, inverse, limit as f32) {
            stack[0] = (0, enter);
            height = 1;
        }
        while height > 0 {
            height -= 1;
            let (node_ix, enter) = stack[height];
            if f64::from(enter) > limit {
                continue;
            }
            let node = &self.tree[node_ix as usize];
            if node.count > 0 {
                for &solid_ix in
                    &self.order[node.first as usize..(node.first + node.count) as usize]
                {
                    limit = limit.min(visit(solid_ix as usize, limit));
                }
                continue;
            }
            let [left, right] = [node.first, node.first + 1].map(|ix| {
                enters(&self.tree[ix as usize], origin, inverse, limit as f32)
                    .map(|enter| (ix, enter))
            });
            let (far, near) = match (left, right) {
                (Some(a), Some(b)) if a.1 < b.1 => (right, left),
                _ => (left, right),
            };
            for child in [far, near].into_iter().flatten() {
                stack[height] = child;
                height += 1;
            }
        }
    }

    /// Linear light that comes back along the ray; `pixel_angle` is the width of a sample in radians.
    pub(crate) fn radiance(&self, ray: &Ray, pixel_angle: f64) -> Rgb {
        let Some(hit) = self.meet(ray, f64::MAX) else {
            return backdrop(ray.direction);
        };
        let solid = &self.solids[hit.solid_ix];
        let point = ray.origin + ray.direction * hit.distance;
        let at = solid.placed.face_point(point, hit.face);
        // A sample is an ellipse on a slanted surface; its mean width keeps texture without flicker.
        let slant = at.normal.dot(ray.direction).abs().max(0.05);
        let footprint = (hit.distance * pixel_angle / slant.sqrt()) as f32;
        let seed = if hit.face == 0 {
            solid.seed
        } else {
            hash(solid.seed ^ u32::from(hit.face))
        };
        let spot = Spot {
            uv: at.uv.as_vec2(),
            half: at.half.as_vec2(),
            footprint,
            face: hit.face,
            seed,
        };
        let colour = solid.paint.colour(&spot).max(Vec3::ZERO);
        if solid.paint.glows() {
            return colour;
        }
        let baked = solid.grids[hit.face as usize].sample(at.uv / at.half);
        let facing = if at.normal.dot(ray.direction) > 0.0 {
            -at.normal
        } else {
            at.normal
        };
        colour * (baked + self.sunlight(point, facing))
    }

    /// The sun alone is asked for at every sample.
    fn sunlight(&self, point: DVec3, normal: DVec3) -> Vec3 {
        let Some((direction, colour)) = self.light.sun else {
            return Vec3::ZERO;
        };
        let lands = normal.dot(direction);
        if lands <= 0.0
            || self.is_covered(
                &Ray {
                    origin: point + normal * 1e-3,
                    direction,
                },
                f64::MAX,
            )
        {
            return Vec3::ZERO;
        }
        colour * lands as f32
    }
}

fn enters(node: &Node, origin: Vec3A, inverse: Vec3A, limit: f32) -> Option<f32> {
    let (a, b) = (
        (node.low - origin) * inverse,
        (node.high - origin) * inverse,
    );
    let enter = a.min(b).max_element().max(0.0);
    let exit = a.max(b).min_element();
    (enter <= exit && enter <= limit).then_some(enter)
}

/// Splits a node where the surfaces of the two boxes, weighted by their number of solids, are smallest together:
/// rays then meet few boxes. A median split would put whole walls into boxes with books.
fn split(
    tree: &mut Vec<Node>,
    node_ix: usize,
    order: &mut [u32],
    first: u32,
    boxes: &[(DVec3, DVec3)],
) {
    let (low, high) = around(order, boxes);
    let pad = DVec3::splat(1e-4);
    let (low, high) = ((low - pad).as_vec3a(), (high + pad).as_vec3a());
    tree[node_ix] = Node {
        low,
        high,
        first,
        count: order.len() as u32,
    };
    if order.len() <= MAX_LEAF {
        return;
    }
    let mut best = (f64::MAX, 0, order.len() / 2);
    for axis in 0..3 {
        sort_along(axis, order, boxes);
        let mut behind = vec![0.0; order.len()];
        let mut whole = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for (n, ix) in order.iter().enumerate().rev() {
            whole = joined(whole, boxes[*ix as usize]);
            behind[n] = surface(whole) * (order.len() - n) as f64;
        }
        let mut whole = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for n in 1..order.len() {
            whole = joined(whole, boxes[order[n - 1] as usize]);
            let cost = surface(whole) * n as f64 + behind[n];
            if cost < best.0 {
                best = (cost, axis, n);
            }
        }
    }
    let (_, axis, n_left) = best;
    sort_along(axis, order, boxes);
    let children = tree.len();
    tree.extend([tree[node_ix]; 2]);
    tree[node_ix].count = 0;
    tree[node_ix].first = children as u32;
    let (left, right) = order.split_at_mut(n_left);
    split(tree, children, left, first, boxes);
    split(tree, children + 1, right, first + n_left as u32, boxes);
}

type Bounds = (DVec3, DVec3);

fn around(order: &[u32], boxes: &[Bounds]) -> Bounds {
    order
        .iter()
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |whole, ix| {
            joined(whole, boxes[*ix as usize])
        })
}

fn joined(a: Bounds, b: Bounds) -> Bounds {
    (a.0.min(b.0), a.1.max(b.1))
}

fn surface((low, high): Bounds) -> f64 {
    let size = high - low;
    size.x * size.y + size.y * size.z + size.z * size.x
}

fn sort_along(axis: usize, order: &mut [u32], boxes: &[Bounds]) {
    let middle = |ix: u32| boxes[ix as usize].0[axis] + boxes[ix as usize].1[axis];
    order.sort_unstable_by(|a, b| middle(*a).total_cmp(&middle(*b)).then(a.cmp(b)));
}
