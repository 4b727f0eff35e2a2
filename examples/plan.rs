//! Plans a way for a round robot on the map of a running mapper, over zenoh, as any client can: A* on `distance_slice`, shortened, and checked in space by
//! `get_distances` and against the splats by `get_ellipsoids`. The way goes out as nav_msgs/Path on /plan, where the mapper's viewer draws it.
#![allow(clippy::print_stdout, reason = "an example speaks to the terminal")]

use std::collections::{BTreeMap, BinaryHeap};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use clap::Parser;
use glam::{DQuat, DVec2, DVec3, IVec2};
use image::{Rgb, RgbImage};
use zenoh::query::ConsolidationMode;
use zenoh::{Config, Session, Wait};

use splat_msgs::ellipsoid_message::EllipsoidArray;
use splat_msgs::map_messages::payload;
use splat_msgs::ros::navigation::DistanceMapSlice;
use splat_msgs::ros::standard::Path as NavPath;
use splat_msgs::ros::{self, Message, PoseStamped};
use splat_msgs::services::SERVICES;
use splat_msgs::type_hash::{dds_name, service_hash, type_hash};
use splat_ros::box_services::{BoxRequest, GetEllipsoidsResponse};
use splat_ros::distances::{GetDistancesRequest, GetDistancesResponse};
use splat_types::transform::Rigid;
use splat_volume::ellipsoids::Ellipsoid;

/// Steps in which a way is checked, metres.
const STEP: f64 = 0.025;
/// Splats are asked for so far beside the robot, metres: their middles may be farther away than their ends.
const REACH: f64 = 0.3;
/// Heights above and below the slice's, metres.
const HEIGHTS: [f64; 5] = [-0.5, -0.25, 0.0, 0.25, 0.5];
/// Each cuts corners once more.
const SMOOTHINGS: usize = 3;
const MAX_PLANS: usize = 50;
const PATIENCE: Duration = Duration::from_secs(10);

/// Plans a way on the map of a running mapper.
#[derive(Parser)]
struct Args {
    /// Where the mapper listens, for example tcp/127.0.0.1:7447; without it peers are found by multicast.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Option<String>,
    #[arg(long, default_value = "splat_mapper")]
    namespace: String,
    #[arg(long, default_value_t = 0)]
    domain: u32,
    /// In the frame of the grid, metres.
    #[arg(long, num_args = 2, value_names = ["X", "Y"], allow_negative_numbers = true)]
    from: Vec<f64>,
    #[arg(long, num_args = 2, value_names = ["X", "Y"], allow_negative_numbers = true)]
    to: Vec<f64>,
    /// Of the robot, metres.
    #[arg(long, default_value_t = 0.2)]
    radius: f64,
    /// Standard deviations that a splat reaches: Splat-Nav and SAFER-Splat take one.
    #[arg(long, default_value_t = 1.0)]
    sigma: f64,
    /// Draws the slice and the way.
    #[arg(long, value_name = "FILE.png")]
    out: Option<PathBuf>,
}

impl Args {
    /// Metres that a way is to have to all sides: the radius, but for what cells leave open.
    fn wanted(&self, slice: &Slice) -> f64 {
        self.radius - f64::from(slice.0.resolution)
    }
}

/// The slice, and what it is asked.
struct Slice(DistanceMapSlice);

impl Slice {
    fn cell(&self, place: DVec2) -> IVec2 {
        let origin = DVec2::new(self.0.origin.x, self.0.origin.y);
        ((place - origin) / f64::from(self.0.resolution))
            .floor()
            .as_ivec2()
    }

    fn middle(&self, cell: IVec2) -> DVec2 {
        let origin = DVec2::new(self.0.origin.x, self.0.origin.y);
        origin + (cell.as_dvec2() + 0.5) * f64::from(self.0.resolution)
    }

    /// Metres to the nearest obstacle; `None` where nobody knows, or outside.
    fn room(&self, cell: IVec2) -> Option<f64> {
        let (width, height) = (self.0.width as i32, self.0.height as i32);
        let is_inside = cell.x >= 0 && cell.y >= 0 && cell.x < width && cell.y < height;
        let at = is_inside.then(|| (cell.y * width + cell.x) as usize)?;
        let distance = *self.0.data.get(at)?;
        (distance < self.0.unknown_value).then_some(f64::from(distance))
    }

    fn is_free(&self, cell: IVec2, radius: f64) -> bool {
        self.room(cell).is_some_and(|room| room > radius)
    }

    fn nearest_free(&self, cell: IVec2, radius: f64) -> Option<DVec2> {
        let width = self.0.width as i32;
        let cells = (0..self.0.data.len() as i32).map(|at| IVec2::new(at % width, at / width));
        let free = cells.filter(|other| self.is_free(*other, radius));
        let nearest = free.min_by_key(|other| (*other - cell).as_i64vec2().length_squared());
        nearest.map(|cell| self.middle(cell))
    }

    /// Whether all of a straight line is.
    fn is_line_free(&self, from: DVec2, to: DVec2, radius: f64) -> bool {
        points_of(&[from, to]).all(|p| self.is_free(self.cell(p), radius))
    }

    /// A* over free cells in eight directions; ways near obstacles cost more.
    fn way(&self, from: IVec2, to: IVec2, radius: f64) -> Option<Vec<IVec2>> {
        let key = |cell: IVec2| (cell.x, cell.y);
        let left = |cell: IVec2| (to - cell).as_dvec2().length();
        let mut best: BTreeMap<(i32, i32), f64> = BTreeMap::from([(key(from), 0.0)]);
        let mut before: BTreeMap<(i32, i32), IVec2> = BTreeMap::new();
        // The smallest first: thousandths of cells.
        let entry = |cost: f64, cell: IVec2| {
            let rank = ((cost + left(cell)) * 1000.0) as u64;
            (std::cmp::Reverse(rank), key(cell))
        };
        let mut queue = BinaryHeap::from([entry(0.0, from)]);
        while let Some((_, (x, y))) = queue.pop() {
            let cell = IVec2::new(x, y);
            if cell == to {
                let mut way = vec![cell];
                while let Some(cell) = before.get(&key(way[way.len() - 1])) {
                    way.push(*cell);
                }
                way.reverse();
                return Some(way);
            }
            let cost = best[&(x, y)];
            for (dx, dy) in (-1..=1).flat_map(|x| (-1..=1).map(move |y| (x, y))) {
                let next = cell + IVec2::new(dx, dy);
                let Some(room) = self.room(next).filter(|room| *room > radius) else {
                    continue;
                };
                let nearness = (2.0 * radius / room).min(2.0);
                let next_cost = cost + f64::from(dx * dx + dy * dy).sqrt() * (1.0 + nearness);
                if best.get(&key(next)).is_none_or(|known| next_cost < *known) {
                    best.insert(key(next), next_cost);
                    before.insert(key(next), cell);
                    queue.push(entry(next_cost, next));
                }
            }
        }
        None
    }

    /// As few corners as the radius allows.
    fn shortened(&self, way: &[IVec2], radius: f64) -> Vec<DVec2> {
        let points: Vec<DVec2> = way.iter().map(|cell| self.middle(*cell)).collect();
        let mut kept = vec![0];
        while let Some(&at) = kept.last().filter(|at| **at + 1 < points.len()) {
            let ahead = (at + 2..points.len())
                .rev()
                .find(|next| self.is_line_free(points[at], points[*next], radius));
            kept.push(ahead.unwrap_or(at + 1));
        }
        kept.into_iter().map(|at| points[at]).collect()
    }

    /// Cells that a way does not go through from now on, so many metres around a place.
    fn block(&mut self, place: DVec2, by: f64) {
        let (width, cell) = (self.0.width as i32, self.cell(place));
        let reach = (by / f64::from(self.0.resolution)).ceil().max(1.0) as i32;
        for (x, y) in (-reach..=reach).flat_map(|x| (-reach..=reach).map(move |y| (x, y))) {
            let at = cell + IVec2::new(x, y);
            if x * x + y * y <= reach * reach && self.room(at).is_some() {
                self.0.data[(at.y * width + at.x) as usize] = 0.0;
            }
        }
    }

    /// With its corners cut (Chaikin 1974) wherever there is room for that.
    fn smoothed(&self, way: &[DVec2], radius: f64) -> Vec<DVec2> {
        let mut way = way.to_vec();
        for _ in 0..SMOOTHINGS {
            let mut cut: Vec<DVec2> = way.first().copied().into_iter().collect();
            for corner in way.windows(3) {
                let [before, at, behind] = corner else {
                    continue;
                };
                let (enter, leave) = (at.lerp(*before, 0.25), at.lerp(*behind, 0.25));
                if self.is_line_free(enter, leave, radius) {
                    cut.extend([enter, leave]);
                } else {
                    cut.push(*at);
                }
            }
            cut.extend(way.last());
            way = cut;
        }
        way
    }

    fn draw(&self, way: &[DVec2], path: &Path) -> Result<()> {
        let (width, height) = (self.0.width, self.0.height);
        let mut image = RgbImage::from_fn(width, height, |x, y| {
            let cell = IVec2::new(x as i32, (height - 1 - y) as i32);
            Rgb(match self.room(cell) {
                None => [200; 3],
                Some(room) if room < 0.0 => [30; 3],
                Some(room) => [
                    255,
                    (150.0 + 105.0 * (room / 0.8).min(1.0)) as u8,
                    (90.0 + 165.0 * (room / 0.8).min(1.0)) as u8,
                ],
            })
        });
        for point in points_of(way) {
            let cell = self.cell(point);
            let (x, y) = (cell.x as u32, height.wrapping_sub(1 + cell.y as u32));
            if x < width && y < height {
                image.put_pixel(x, y, Rgb([20, 90, 220]));
            }
        }
        image.save(path).with_context(|| path.display().to_string())
    }
}

/// Along the way, `STEP` apart.
fn points_of(way: &[DVec2]) -> impl Iterator<Item = DVec2> + '_ {
    way.windows(2).flat_map(|pair| {
        let n = (pair[0].distance(pair[1]) / STEP).ceil().max(1.0) as u32;
        (0..=n).map(move |i| pair[0].lerp(pair[1], f64::from(i) / f64::from(n)))
    })
}

/// The answers to a question; latched topics answer with their newest message.
fn ask(session: &Session, key: &str, question: Vec<u8>) -> Result<Vec<Vec<u8>>> {
    let query = session
        .get(key)
        .consolidation(ConsolidationMode::None)
        .payload(question)
        .timeout(PATIENCE);
    let replies = query.wait().map_err(|e| anyhow!("{key}: {e}"))?;
    let samples = replies
        .into_iter()
        .filter_map(|reply| reply.into_result().ok());
    Ok(samples
        .map(|sample| sample.payload().to_bytes().into_owned())
        .collect())
}

/// As rmw_zenoh spells it: domain, name, type and its hash. Services leave wildcards without an answer.
fn service_key(args: &Args, name: &str) -> Option<String> {
    let service = SERVICES.iter().find(|service| service.name == name)?;
    let definitions = (service.request_definition, service.response_definition);
    let hash = service_hash(service.type_name, definitions.0, definitions.1);
    let dds_type = dds_name(service.type_name);
    Some(format!(
        "{}/{}/{name}/{dds_type}/{hash}",
        args.domain, args.namespace
    ))
}

fn session(args: &Args) -> Result<Session> {
    let mut config = Config::default();
    let endpoints: Vec<&String> = args.connect.iter().collect();
    let settings = [
        ("listen/endpoints", "[]".to_owned()),
        (
            "scouting/multicast/enabled",
            args.connect.is_none().to_string(),
        ),
        (
            "connect/endpoints",
            serde_json::json!(endpoints).to_string(),
        ),
    ];
    for (key, json) in settings {
        let set = config.insert_json5(key, &json);
        set.map_err(|e| anyhow!("{key}: {e}"))?;
    }
    let session = zenoh::open(config).wait();
    session.map_err(|e| anyhow!("cannot open zenoh: {e}"))
}

/// (least room along the way, points that nobody has seen, all points), at all heights.
fn checked(
    session: &Session,
    args: &Args,
    slice: &Slice,
    way: &[DVec2],
) -> Result<(f32, usize, usize)> {
    let heights = HEIGHTS.map(|above| slice.0.origin.z + above);
    let points = points_of(way).flat_map(|p| heights.map(|z| [p.x as f32, p.y as f32, z as f32]));
    let question = GetDistancesRequest {
        frame_id: slice.0.header.frame_id.clone(),
        points: points.flatten().collect(),
        max_distance: 2.0,
    };
    let key = service_key(args, "get_distances").context("there is no such service")?;
    let answers = ask(session, &key, ros::encode_plain(&question)?)?;
    let answer = answers.first().context("get_distances does not answer")?;
    let answer: GetDistancesResponse = ros::decode_plain(answer)?;
    if !answer.success {
        bail!("get_distances: {}", answer.message);
    }
    let least = answer
        .distances
        .iter()
        .copied()
        .fold(f32::INFINITY, f32::min);
    let n_unknown = answer.known.iter().filter(|known| !**known).count();
    Ok((least, n_unknown, answer.known.len()))
}

/// What splats leave of a way, at all heights.
struct AmongSplats {
    /// Metres.
    least: f64,
    n: usize,
    /// Where it is too narrow, and by how much.
    narrow: Vec<(DVec2, f64)>,
}

fn among_splats(
    session: &Session,
    args: &Args,
    slice: &Slice,
    way: &[DVec2],
) -> Result<AmongSplats> {
    let mut found = AmongSplats {
        least: f64::INFINITY,
        n: 0,
        narrow: Vec::new(),
    };
    let wanted = args.wanted(slice);
    let points: Vec<DVec2> = points_of(way).collect();
    // Boxes along the way: one around all of it may hold too many.
    for part in points.chunks(40) {
        let ellipsoids = ellipsoids_beside(session, args, slice, part)?;
        found.n += ellipsoids.len();
        for place in part {
            let mut least = f64::INFINITY;
            for at in HEIGHTS.map(|above| place.extend(slice.0.origin.z + above)) {
                for ellipsoid in &ellipsoids {
                    let reach = ellipsoid.semi_axes.max_element();
                    if at.distance(ellipsoid.mean) - reach < least {
                        least = least.min(ellipsoid.distance(at));
                    }
                }
            }
            found.least = found.least.min(least);
            if least < wanted {
                found.narrow.push((*place, wanted - least));
            }
        }
    }
    Ok(found)
}

/// Splats around points of a way.
fn ellipsoids_beside(
    session: &Session,
    args: &Args,
    slice: &Slice,
    part: &[DVec2],
) -> Result<Vec<Ellipsoid>> {
    let key = service_key(args, "get_ellipsoids").context("there is no such service")?;
    let ends = |pick: fn(DVec2, DVec2) -> DVec2| part.iter().copied().reduce(pick);
    let (Some(low), Some(high)) = (ends(DVec2::min), ends(DVec2::max)) else {
        return Ok(Vec::new());
    };
    let margin = args.radius + REACH;
    let (bottom, top) = (HEIGHTS[0] - margin, HEIGHTS[HEIGHTS.len() - 1] + margin);
    let corner = |xy: DVec2, z: f64| xy.extend(slice.0.origin.z + z).as_vec3().to_array();
    let question = BoxRequest {
        frame_id: slice.0.header.frame_id.clone(),
        low: corner(low - margin, bottom),
        high: corner(high + margin, top),
    };
    let answers = ask(session, &key, ros::encode_plain(&question)?)?;
    let answer = answers.first().context("get_ellipsoids does not answer")?;
    let answer: GetEllipsoidsResponse = ros::decode_plain(answer)?;
    if !answer.success {
        bail!("get_ellipsoids: {}", answer.message);
    }
    if answer.ellipsoids.n_left_out > 0 {
        bail!("more splats beside the way than one answer holds: take a smaller radius");
    }
    ellipsoids_of(&answer.ellipsoids, args.sigma)
}

fn ellipsoids_of(array: &EllipsoidArray, sigma: f64) -> Result<Vec<Ellipsoid>> {
    let n = array.ids.len();
    let share = sigma / f64::from(array.k_sigma);
    let triples = |values: &[f32], name: &str| -> Result<Vec<DVec3>> {
        let (triples, rest) = values.as_chunks::<3>();
        if triples.len() != n || !rest.is_empty() {
            bail!("{} numbers of {name} for {n} ellipsoids", values.len());
        }
        let of = |t: &[f32; 3]| DVec3::from_array(t.map(f64::from));
        Ok(triples.iter().map(of).collect())
    };
    let (means, axes) = (
        triples(&array.means, "means")?,
        triples(&array.semi_axes, "semi_axes")?,
    );
    let (rotations, _) = array.rotations.as_chunks::<4>();
    let all = means.into_iter().zip(axes).zip(rotations).zip(&array.ids);
    Ok(all
        .map(|(((mean, semi_axes), q), id)| Ellipsoid {
            splat_id: *id,
            mean,
            rotation: DQuat::from_array(q.map(f64::from)).normalize(),
            semi_axes: semi_axes * share,
            opacity: 1.0,
            observations: 0,
            last_keyframe: 0,
            position_sigma: 0.0,
        })
        .collect())
}

/// A way that is clear on the slice and among the splats: where those leave too little room, it is planned anew around that place.
fn plan(
    session: &Session,
    args: &Args,
    slice: &mut Slice,
    [from, to]: [IVec2; 2],
) -> Result<(Vec<DVec2>, AmongSplats)> {
    for _ in 0..MAX_PLANS {
        let Some(way) = slice.way(from, to, args.radius) else {
            bail!(
                "no way: what is known and free between the two places is narrower than the robot"
            );
        };
        let way = slice.smoothed(&slice.shortened(&way, args.radius), args.radius);
        let found = among_splats(session, args, slice, &way)?;
        if found.narrow.is_empty() {
            return Ok((way, found));
        }
        for (place, by) in &found.narrow {
            slice.block(*place, *by);
        }
    }
    bail!("no way: wherever the slice has room, splats reach into it");
}

/// As Nav2's planners publish theirs.
fn publish(session: &Session, args: &Args, slice: &Slice, way: &[DVec2]) -> Result<()> {
    let header = slice.0.header.clone();
    let pose = |p: DVec2| PoseStamped {
        header: header.clone(),
        pose: Rigid::new(DQuat::IDENTITY, p.extend(0.0)).into(),
    };
    let path = NavPath {
        poses: points_of(way).step_by(4).map(pose).collect(),
        header: header.clone(),
    };
    let key = format!(
        "{}/plan/{}/{}",
        args.domain,
        dds_name(NavPath::TYPE_NAME),
        type_hash::<NavPath>()
    );
    let sent = session.put(&key, payload(&path)?).wait();
    sent.map_err(|e| anyhow!("{key}: {e}"))
}

fn main() -> Result<()> {
    let args = Args::parse();
    let ([from_x, from_y], [to_x, to_y]) = (args.from[..].try_into()?, args.to[..].try_into()?);
    let session = session(&args)?;
    let key = format!("{}/{}/distance_slice/**", args.domain, args.namespace);
    let slices = ask(&session, &key, Vec::new())?;
    let slice = slices
        .last()
        .context("no distance_slice yet: is the mapper running, and is its scale known?")?;
    let mut slice = Slice(ros::decode::<DistanceMapSlice>(slice)?);
    let ends = [DVec2::new(from_x, from_y), DVec2::new(to_x, to_y)].map(|end| slice.cell(end));
    for (name, end) in ["--from", "--to"].into_iter().zip(ends) {
        if slice.is_free(end, args.radius) {
            continue;
        }
        let why = match slice.room(end) {
            None => "nobody has seen this place".to_owned(),
            Some(room) => format!("the nearest obstacle is {room:.2} m away"),
        };
        let near = slice.nearest_free(end, args.radius);
        let near = near.context("there is no room for the robot anywhere")?;
        bail!(
            "{name}: {why}; the nearest place with room is {:.2} {:.2}",
            near.x,
            near.y
        );
    }
    let (way, splats) = plan(&session, &args, &mut slice, ends)?;
    for point in &way {
        println!("{:.3} {:.3}", point.x, point.y);
    }
    let length: f64 = way.windows(2).map(|pair| pair[0].distance(pair[1])).sum();
    let (least, n_unknown, n) = checked(&session, &args, &slice, &way)?;
    println!(
        "{length:.2} m in {}, {} points; in space the nearest surface is {least:.2} m away, {n_unknown} of {n} points are unseen",
        slice.0.header.frame_id,
        way.len()
    );
    println!(
        "the nearest of {} splats beside it, at {} sigma, is {:.2} m away",
        splats.n, args.sigma, splats.least
    );
    publish(&session, &args, &slice, &way)?;
    if let Some(out) = &args.out {
        slice.draw(&way, out)?;
    }
    if f64::from(least) < args.wanted(&slice) {
        bail!("the way is not clear of obstacles at all heights");
    }
    Ok(())
}
