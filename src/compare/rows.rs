//! The methods that a comparison knows, each as parameters of a replay.

/// Steps after which 3R-GS drops the epipolar loss, of its 30,000; shorter runs end it at the same share.
const EPIPOLAR_SHARE: f64 = 0.1;

/// One way to map a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Row {
    Ours,
    FastSplatting,
    Gaussian3d,
    ColmapGaussian3d,
    Mcmc,
    ThreeRgs,
}

/// What all rows of a comparison share.
#[derive(Debug, Clone, PartialEq)]
pub struct Shared {
    pub steps: u64,
    pub max_side: u32,
    pub max_splats: usize,
    /// Images drawn from the scene by the seed; 0 = all.
    pub images: usize,
    /// Where FastSplatting and ours take poses and depth from: sfm or onnx:FILE.
    pub geometry: String,
    pub backend: String,
    pub seed: u64,
    pub holdout: u32,
    /// ONNX file of LPIPS; empty = none.
    pub lpips_model: String,
}

impl Row {
    pub const ALL: [Self; 6] = [
        Self::Ours,
        Self::FastSplatting,
        Self::Gaussian3d,
        Self::ColmapGaussian3d,
        Self::Mcmc,
        Self::ThreeRgs,
    ];

    /// As `--rows` names it, and its folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ours => "ours",
            Self::FastSplatting => "fastsplatting",
            Self::Gaussian3d => "3dgs",
            Self::ColmapGaussian3d => "colmap_3dgs",
            Self::Mcmc => "3dgs_mcmc",
            Self::ThreeRgs => "3rgs",
        }
    }

    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|row| row.name() == name)
    }

    /// For the table.
    pub fn title(self) -> &'static str {
        match self {
            Self::Ours => "ours (defaults)",
            Self::FastSplatting => "FastSplatting (preset paper)",
            Self::Gaussian3d => "3DGS from the scene's points and poses",
            Self::ColmapGaussian3d => "COLMAP + 3DGS",
            Self::Mcmc => "3DGS-MCMC at the scene's poses",
            Self::ThreeRgs => "3R-GS at the scene's poses, disturbed",
        }
    }

    /// Whether the scene must bring poses: only images are known of the others.
    pub fn needs_poses(self) -> bool {
        matches!(self, Self::Gaussian3d | Self::Mcmc | Self::ThreeRgs)
    }

    /// Whether the scene must bring sparse points.
    pub fn needs_points(self) -> bool {
        self == Self::Gaussian3d
    }

    /// Arguments of `replay`, without its input and `--out`. Methods whose schedule counts steps have it shortened to the steps of
    /// this comparison.
    pub fn arguments(self, shared: &Shared) -> Vec<String> {
        let mut arguments: Vec<String> = Vec::new();
        let mut add = |flag: &str, value: &str| {
            arguments.extend([flag.to_owned(), value.to_owned()]);
        };
        match self {
            Self::Ours => {}
            Self::FastSplatting | Self::Mcmc | Self::ThreeRgs => add("--preset", "paper"),
            Self::Gaussian3d | Self::ColmapGaussian3d => add("--preset", "3dgs"),
        }
        add("--backend", &shared.backend);
        add("--steps", &shared.steps.to_string());
        add("--max-side", &shared.max_side.to_string());
        add("--seed", &shared.seed.to_string());
        // Counted by the source's frames instead of by keyframes, which each row chooses for itself.
        add("--holdout", "0");
        for setting in self.settings(shared) {
            add("--set", &setting);
        }
        arguments
    }

    fn settings(self, shared: &Shared) -> Vec<String> {
        let quarter = (shared.steps / 4).max(1);
        let at = [1, 2, 3].map(|k| (k * quarter).to_string()).join(",");
        // COLMAP's scene holds the drawn images, and perhaps not all of them: their names say which are held out.
        let (images, holdout) = match self {
            Self::ColmapGaussian3d => (0, 0),
            _ => (shared.images, shared.holdout),
        };
        let mut all = vec![
            format!("source.subsample={images}"),
            format!("select.holdout_frames={holdout}"),
            format!("train.max_side={}", shared.max_side),
            format!("map.max_splats={}", shared.max_splats),
            format!("eval.at_steps={at}"),
            // The table compares all rows by one protocol.
            "eval.train_views=0".to_owned(),
            "eval.pose_steps=100".to_owned(),
            "eval.pose_rate=0.0008".to_owned(),
            "eval.pose_loss=masked_l1".to_owned(),
        ];
        if !shared.lpips_model.is_empty() {
            all.push(format!("eval.lpips_model={}", shared.lpips_model));
        }
        let share = |of: u64, whole: u64| (of * shared.steps / whole).max(1);
        let geometry = if self.needs_poses() || self == Self::ColmapGaussian3d {
            "ground_truth"
        } else {
            &shared.geometry
        };
        all.push(format!("geometry={geometry}"));
        match self {
            Self::Ours => {}
            Self::FastSplatting | Self::Mcmc | Self::ThreeRgs => {
                // Of 7,000 steps.
                all.push(format!("train.sh_interval={}", share(1000, 7000)));
                all.push(format!("mcmc.start={}", share(500, 7000)));
                all.push(format!("mcmc.every={}", share(100, 7000)));
            }
            Self::Gaussian3d | Self::ColmapGaussian3d => {
                // Of 30,000 steps.
                all.push(format!("train.sh_interval={}", share(1000, 30_000)));
                all.push(format!("densify.start={}", share(500, 30_000)));
                all.push(format!("densify.until={}", share(15_000, 30_000)));
                all.push(format!("densify.every={}", share(100, 30_000).max(10)));
                let reset = share(3000, 30_000).max(100);
                all.push(format!("densify.opacity_reset_every={reset}"));
            }
        }
        match self {
            Self::Mcmc => {
                all.extend(["train.pose_opt=fixed", "train.depth_weight=0"].map(Into::into));
            }
            Self::ThreeRgs => {
                let until = ((shared.steps as f64 * EPIPOLAR_SHARE) as u64).max(1);
                all.extend(
                    [
                        "train.depth_weight=0",
                        "train.epipolar_weight=2",
                        "ground_truth.rotation_noise_deg=0.5",
                        "ground_truth.translation_noise_extent=0.005",
                    ]
                    .map(Into::into),
                );
                all.push(format!("train.epipolar_until={until}"));
            }
            _ => {}
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::settings::Settings;

    fn shared(steps: u64) -> Shared {
        Shared {
            steps,
            max_side: 240,
            max_splats: 60_000,
            images: 0,
            geometry: "sfm".to_owned(),
            backend: "cpu".to_owned(),
            seed: 1,
            holdout: 10,
            lpips_model: String::new(),
        }
    }

    #[test]
    fn every_row_is_found_by_its_name_and_has_parameters_that_there_are() {
        for row in Row::ALL {
            assert_eq!(Row::by_name(row.name()), Some(row));
            for steps in [1, 400, 7000, 30_000] {
                let arguments = row.arguments(&shared(steps));
                let mut settings = Settings::shipped();
                for pair in arguments.chunks(2) {
                    if pair[0] == "--set" {
                        settings.merge_setting(&pair[1]).unwrap();
                    }
                }
                settings.params().unwrap();
            }
        }
        assert_eq!(Row::by_name("4dgs"), None);
    }

    #[test]
    fn schedules_shrink_with_the_steps() {
        let of = |row: Row, steps| row.arguments(&shared(steps)).join(" ");
        let short = of(Row::FastSplatting, 700);
        assert!(short.contains("train.sh_interval=100 ") && short.contains("mcmc.start=50 "));
        let whole = of(Row::FastSplatting, 7000);
        assert!(whole.contains("train.sh_interval=1000 ") && whole.contains("mcmc.every=100"));
        assert!(of(Row::Gaussian3d, 30_000).contains("densify.until=15000"));
        assert!(of(Row::ThreeRgs, 30_000).contains("train.epipolar_until=3000"));
    }
}
