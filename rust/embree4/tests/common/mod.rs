//! What the tests share: where the library is, random numbers, a random scene in two forms.
// Each test file is a crate of its own and uses its part of this.
#![allow(dead_code, unreachable_pub)]

use std::path::PathBuf;

use embree4::{Device, Quadric, Ray, Scene, SceneBuilder, brute};

/// Where `make` and `pip install embreex` put the library: `PSSFLOW_EMBREE_DIRS` is looked at by the crate
/// itself, the workspace's `.venv` here.
pub fn candidates() -> Vec<PathBuf> {
    let venv = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../.venv/lib");
    let pythons = std::fs::read_dir(venv).into_iter().flatten().flatten();
    pythons
        .map(|entry| entry.path().join("site-packages"))
        .filter(|dir| dir.is_dir())
        .collect()
}

#[allow(clippy::expect_used)]
pub fn device() -> Device {
    Device::with_candidates(&candidates()).expect("the tests need Embree 4")
}

/// SplitMix64: enough for test scenes, and the crate needs no generator.
pub struct Random(pub u64);

impl Random {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in [−1, 1).
    pub fn signed(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    pub fn vector(&mut self, scale: f32) -> [f32; 3] {
        [0; 3].map(|_| scale * self.signed())
    }

    /// A ray from the cube of half-width 4 towards a point of the cube of half-width 1.5, not normalised.
    pub fn ray(&mut self) -> Ray {
        let (origin, target) = (self.vector(4.0), self.vector(1.5));
        Ray::new(origin, [0, 1, 2].map(|i| target[i] - origin[i]))
    }

    /// Rotation, anisotropic scale (one axis down to a tenth), shear, reflection half of the time, shift.
    pub fn transform(&mut self) -> [f32; 12] {
        loop {
            let columns = [0; 3].map(|_| {
                let length = 0.1 + self.signed().abs();
                let v = self.vector(1.0);
                let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt();
                v.map(|x| x * length / norm)
            });
            let [a, b, c] = columns;
            let det = a[0] * (b[1] * c[2] - b[2] * c[1])
                + a[1] * (b[2] * c[0] - b[0] * c[2])
                + a[2] * (b[0] * c[1] - b[1] * c[0]);
            let size: f32 = columns
                .iter()
                .map(|v| v.iter().map(|x| x * x).sum::<f32>().sqrt())
                .product();
            // Nearly flat maps make nearly flat shapes, on which single and double precision part.
            if det.abs() > 0.2 * size {
                let o = self.vector(1.0);
                return [
                    a[0], b[0], c[0], o[0], a[1], b[1], c[1], o[1], a[2], b[2], c[2], o[2],
                ];
            }
        }
    }

    pub fn mesh(&mut self, triangles: u32) -> (Vec<f32>, Vec<u32>) {
        let mut positions = Vec::new();
        for _ in 0..triangles {
            let center = self.vector(1.0);
            for _ in 0..3 {
                let corner = self.vector(0.5);
                positions.extend((0..3).map(|i| center[i] + corner[i]));
            }
        }
        (positions, (0..3 * triangles).collect())
    }
}

/// One scene, for Embree and for the oracle.
pub struct Twin {
    pub builder: SceneBuilder,
    pub brute: brute::Scene,
}

#[allow(clippy::unwrap_used)]
impl Twin {
    pub fn new(device: &Device) -> Self {
        Self {
            builder: SceneBuilder::new(device).unwrap(),
            brute: brute::Scene::new(),
        }
    }

    pub fn mesh(&mut self, (positions, faces): &(Vec<f32>, Vec<u32>)) -> &mut Self {
        let id = self.builder.triangles(positions, faces).unwrap();
        assert_eq!(id, self.brute.triangles(positions, faces).unwrap());
        self
    }

    pub fn quadric(&mut self, quadric: Quadric) -> &mut Self {
        let id = self.builder.quadric(quadric).unwrap();
        assert_eq!(id, self.brute.quadric(quadric).unwrap());
        self
    }

    pub fn instance(
        &mut self,
        (scene, brute): &(Scene, brute::Scene),
        to_world: &[f32; 12],
    ) -> &mut Self {
        let id = self.builder.instance(scene, to_world).unwrap();
        assert_eq!(id, self.brute.instance(brute, to_world).unwrap());
        self
    }

    pub fn commit(self) -> (Scene, brute::Scene) {
        (self.builder.commit().unwrap(), self.brute)
    }
}

/// Meshes, all three quadrics and two instances in one scene.
pub fn everything(device: &Device, random: &mut Random) -> (Scene, brute::Scene) {
    let mut inner = Twin::new(device);
    inner.mesh(&random.mesh(20)).quadric(Quadric::Sphere {
        center: random.vector(0.5),
        radius: 0.4,
    });
    inner.quadric(Quadric::Cylinder {
        to_world: random.transform(),
    });
    let inner = inner.commit();
    let mut outer = Twin::new(device);
    outer
        .mesh(&random.mesh(30))
        .instance(&inner, &random.transform());
    outer.quadric(Quadric::Disk {
        to_world: random.transform(),
    });
    outer
        .instance(&inner, &random.transform())
        .mesh(&random.mesh(10));
    outer.commit()
}
