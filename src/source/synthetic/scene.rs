//! A scene: painted solids, found fast along rays, under light that was computed once.
//!
//! `Props` is how the scene files put things in place; `Scene` is what the camera sees.

use glam::{DMat3, DVec2, DVec3, Vec3};

use super::geometry::{Placed, Ray, Shape};
use super::light::{Grid, Light};
use super::noise::hash;
use super::textures::{Paint, Rgb, Spot};

#[derive(Debug)]
pub(super) struct Solid {
    pub(super) placed: Placed,
    pub(super) paint: Paint,
    pub(super) seed: u32,
    /// One light grid for each face; empty for what shines.
    pub(super) grids: Vec<Grid>,
}

/// Where a ray ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    pub(super) distance: f64,
    pub(super) solid_ix: usize,
    pub(super) face: u8,
}

#[derive(Debug)]
pub(super) struct Scene {
    pub(super) solids: Vec<Solid>,
    pub(super) light: Light,
    tree: Vec<Node>,
    order: Vec<u32>,
}

/// Inner nodes have `count` 0 and their children at `first` and `first + 1`; leaves name a range of `order`.
#[derive(Debug, Clone, Copy)]
struct Node {
    low: DVec3,
    high: DVec3,
    first: u32,
    count: u32,
}

/// A leaf this small is cheaper to test than to split.
const MAX_LEAF: usize = 2;
/// Depth of the tree is about log2 of the number of solids; the stack holds one entry a level.
const MAX_STACK: usize = 64;

impl Scene {
    pub(super) fn new(props: Props, light: Light) -> Self {
        let solids = props.solids;
        let boxes: Vec<(DVec3, DVec3)> = solids.iter().map(|solid| solid.placed.bounds()).collect();
        let mut order: Vec<u32> = (0..solids.len() as u32).collect();
        let mut tree = vec![Node { low: DVec3::ZERO, high: DVec3::ZERO, first: 0, count: 0 }];
        split(&mut tree, 0, &mut order, 0, &boxes);
        let mut scene = Self { solids, light, tree, order };
        let grids = scene.light.bake(&scene);
        for (solid, grids) in scene.solids.iter_mut().zip(grids) {
            solid.grids = grids;
        }
        scene
    }

    pub(super) fn meet(&self, ray: &Ray, farthest: f64) -> Option<Hit> {
        let mut nearest = None;
        let mut limit = farthest;
        self.walk(ray, |solid_ix, limit_so_far| {
            if let Some((distance, face)) = self.solids[solid_ix].placed.meet(ray, limit_so_far.min(limit)) {
                limit = distance;
                nearest = Some(Hit { distance, solid_ix, face });
            }
            limit
        }, farthest);
        nearest
    }

    /// Whether anything that is not a lamp itself lies on the ray before `farthest`.
    pub(super) fn is_covered(&self, ray: &Ray, farthest: f64) -> bool {
        let mut covered = false;
        self.walk(ray, |solid_ix, limit| {
            let solid = &self.solids[solid_ix];
            covered = covered || (!solid.paint.glows() && solid.placed.meet(ray, limit).is_some());
            if covered { 0.0 } else { limit }
        }, farthest);
        covered
    }

    /// Visits the solids whose boxes the ray crosses, near ones first; `visit` answers how far to look on.
    fn walk(&self, ray: &Ray, mut visit: impl FnMut(usize, f64) -> f64, farthest: f64) {
        let inverse = ray.direction.recip();
        let mut limit = farthest;
        let mut stack = [(0u32, 0.0f64); MAX_STACK];
        let mut height = 0;
        let root = &self.tree[0];
        if let Some(enter) = enters(root, ray.origin, inverse, limit) {
            stack[0] = (0, enter);
            height = 1;
        }
        while height > 0 {
            height -= 1;
            let (node_ix, enter) = stack[height];
            if enter > limit {
                continue;
            }
            let node = &self.tree[node_ix as usize];
            if node.count > 0 {
                for &solid_ix in &self.order[node.first as usize..(node.first + node.count) as usize] {
                    limit = limit.min(visit(solid_ix as usize, limit));
                }
                continue;
            }
            let [left, right] = [node.first, node.first + 1].map(|ix| {
                enters(&self.tree[ix as usize], ray.origin, inverse, limit).map(|enter| (ix, enter))
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
    pub(super) fn radiance(&self, ray: &Ray, pixel_angle: f64) -> Rgb {
        let Some(hit) = self.meet(ray, f64::MAX) else { return self.light.backdrop(ray.direction) };
        let solid = &self.solids[hit.solid_ix];
        let point = ray.origin + ray.direction * hit.distance;
        let at = solid.placed.face_point(point, hit.face);
        // A sample is an ellipse on a slanted surface; its mean width keeps texture without flicker.
        let slant = at.normal.dot(ray.direction).abs().max(0.05);
        let footprint = (hit.distance * pixel_angle / slant.sqrt()) as f32;
        let seed = if hit.face == 0 { solid.seed } else { hash(solid.seed ^ u32::from(hit.face)) };
        let spot = Spot { uv: at.uv.as_vec2(), half: at.half.as_vec2(), footprint, face: hit.face, seed };
        let colour = solid.paint.colour(&spot).max(Vec3::ZERO);
        if solid.paint.glows() {
            return colour;
        }
        let baked = solid.grids[hit.face as usize].sample(at.uv / at.half);
        let facing = if at.normal.dot(ray.direction) > 0.0 { -at.normal } else { at.normal };
        colour * (baked + self.light.sunlight(self, point, facing))
    }
}

fn enters(node: &Node, origin: DVec3, inverse: DVec3, limit: f64) -> Option<f64> {
    let (a, b) = ((node.low - origin) * inverse, (node.high - origin) * inverse);
    let enter = a.min(b).max_element().max(0.0);
    let exit = a.max(b).min_element();
    (enter <= exit && enter <= limit).then_some(enter)
}

/// Halves the solids of a node at the median of their centres along the longest side.
fn split(tree: &mut Vec<Node>, node_ix: usize, order: &mut [u32], first: u32, boxes: &[(DVec3, DVec3)]) {
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &ix in order.iter() {
        let (a, b) = boxes[ix as usize];
        (low, high) = (low.min(a), high.max(b));
    }
    tree[node_ix] = Node { low, high, first, count: order.len() as u32 };
    if order.len() <= MAX_LEAF {
        return;
    }
    let middle = |ix: u32| boxes[ix as usize].0 + boxes[ix as usize].1;
    let spread = |axis: usize| {
        let values = order.iter().map(|ix| middle(*ix)[axis]);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        high - low
    };
    let axis = (0..3).max_by(|a, b| spread(*a).total_cmp(&spread(*b))).unwrap_or(0);
    order.sort_unstable_by(|a, b| middle(*a)[axis].total_cmp(&middle(*b)[axis]).then(a.cmp(b)));
    let children = tree.len();
    tree.extend([tree[node_ix]; 2]);
    tree[node_ix].count = 0;
    tree[node_ix].first = children as u32;
    let (left, right) = order.split_at_mut(order.len() / 2);
    let n_left = left.len() as u32;
    split(tree, children, left, first, boxes);
    split(tree, children + 1, right, first + n_left, boxes);
}

/// Puts solids in place; a group of things shares the frame set by `at`.
#[derive(Debug)]
pub(super) struct Props {
    solids: Vec<Solid>,
    origin: DVec3,
    turn: DMat3,
}

impl Props {
    pub(super) fn new() -> Self {
        Self { solids: Vec::new(), origin: DVec3::ZERO, turn: DMat3::IDENTITY }
    }

    /// From here on places are meant from `origin`, turned by `yaw_deg` about z.
    pub(super) fn at(&mut self, origin: DVec3, yaw_deg: f64) -> &mut Self {
        self.origin = origin;
        self.turn = DMat3::from_rotation_z(yaw_deg.to_radians());
        self
    }

    pub(super) fn add(&mut self, shape: Shape, centre: DVec3, local: DMat3, paint: Paint) {
        let placed = Placed { shape, centre: self.origin + self.turn * centre, world_from_local: self.turn * local };
        let seed = hash(self.solids.len() as u32 + 1);
        self.solids.push(Solid { placed, paint, seed, grids: Vec::new() });
    }

    /// A box by its centre and full size.
    pub(super) fn block(&mut self, centre: [f64; 3], size: [f64; 3], paint: Paint) {
        let half = 0.5 * DVec3::from_array(size);
        self.add(Shape::Block { half }, DVec3::from_array(centre), DMat3::IDENTITY, paint);
    }

    /// A box turned about its own centre.
    pub(super) fn turned_block(&mut self, centre: [f64; 3], size: [f64; 3], local: DMat3, paint: Paint) {
        let half = 0.5 * DVec3::from_array(size);
        self.add(Shape::Block { half }, DVec3::from_array(centre), local, paint);
    }

    /// A cone cut off at both ends: centre, height, radius below and above.
    pub(super) fn tube(&mut self, centre: [f64; 3], height: f64, radii: [f64; 2], paint: Paint) {
        let shape = Shape::Tube { half_height: 0.5 * height, bottom: radii[0], top: radii[1] };
        self.add(shape, DVec3::from_array(centre), DMat3::IDENTITY, paint);
    }

    pub(super) fn ball(&mut self, centre: [f64; 3], radii: [f64; 3], paint: Paint) {
        let shape = Shape::Ball { radii: DVec3::from_array(radii) };
        self.add(shape, DVec3::from_array(centre), DMat3::IDENTITY, paint);
    }

    /// An upright sheet that looks to `facing_deg` (0 along +x, 90 along +y).
    pub(super) fn sheet(&mut self, centre: [f64; 3], facing_deg: f64, size: [f64; 2], paint: Paint) {
        let normal = DMat3::from_rotation_z(facing_deg.to_radians()) * DVec3::X;
        let local = DMat3::from_cols(DVec3::Z.cross(normal), DVec3::Z, normal);
        let shape = Shape::Sheet { half: 0.5 * DVec2::from_array(size), round: false };
        self.add(shape, DVec3::from_array(centre), local, paint);
    }

    /// A sheet that lies flat and looks up, or down where `up` is negative.
    pub(super) fn flat(&mut self, centre: [f64; 3], up: f64, size: [f64; 2], paint: Paint) {
        let local = DMat3::from_cols(DVec3::X, DVec3::Y * up.signum(), DVec3::Z * up.signum());
        let shape = Shape::Sheet { half: 0.5 * DVec2::from_array(size), round: false };
        self.add(shape, DVec3::from_array(centre), local, paint);
    }

    /// A picture in a wooden frame, hung so that it looks to `facing_deg`; `size` without the frame.
    pub(super) fn framed(&mut self, centre: [f64; 3], facing_deg: f64, size: [f64; 2], frame: Paint, motif: Paint) {
        const RIM: f64 = 0.035;
        let normal = DMat3::from_rotation_z(facing_deg.to_radians()) * DVec3::X;
        let local = DMat3::from_cols(DVec3::Z.cross(normal), DVec3::Z, normal);
        let centre = DVec3::from_array(centre);
        let half = DVec3::new(0.5 * size[0] + RIM, 0.5 * size[1] + RIM, 0.015);
        self.add(Shape::Block { half }, centre + normal * 0.015, local, frame);
        let sheet = Shape::Sheet { half: 0.5 * DVec2::from_array(size), round: false };
        self.add(sheet, centre + normal * 0.032, local, motif);
    }
}
