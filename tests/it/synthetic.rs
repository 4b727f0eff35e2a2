//! temporary
use splat_mapper::source::synthetic::{SynthSettings, take::Take};
#[test]
fn look() {
    let spec = std::env::var("LOOK").unwrap_or("room".into());
    let step: u32 = std::env::var("STEP").unwrap_or("15".into()).parse().unwrap();
    let settings = SynthSettings::parse(&spec).unwrap();
    let start = splat_mapper::clock::Stopwatch::start();
    let take = Take::new(settings).unwrap();
    eprintln!("build {:.2}", start.secs());
    for ix in (0..take.settings().n_frames).step_by(step as usize) {
        let start = splat_mapper::clock::Stopwatch::start();
        let p = take.picture(ix);
        eprintln!("frame {ix} {:.2}", start.secs());
        image::save_buffer(format!("/tmp/synth/{}{ix:03}.png", &spec[..4]), &p.pixels, p.width_px, p.height_px, image::ExtendedColorType::Rgb8).unwrap();
    }
}
