//! Light that nothing reflects: emitters that the camera sees, Mitsuba's `path` at `max_depth` 1.

use crate::math::{Rgb, Vec3};
use crate::packet::Packet;
use crate::path::Tracer;
use crate::paths::Paths;

impl Tracer<'_> {
    /// Fills f with what each camera ray sees shine; none of it where emitters are hidden, backgrounds included, as in
    /// Mitsuba.
    pub(crate) fn seen_emission(&self, paths: &mut Paths) {
        let scene = self.scene();
        if scene.hides_emitters() {
            return;
        }
        let mut packet = Packet::new();
        for lane in 0..paths.len() {
            let ray = paths.states[lane].ray;
            if let Some(log) = &mut paths.rays {
                log.camera.push(ray);
            }
            let last = lane + 1 == paths.len();
            if !packet.push(ray, lane) && !last {
                continue;
            }
            packet.intersect(scene.accel(), true, |lane, ray, hit| {
                let d = Vec3::from_array(ray.dir);
                let eval = |e: usize, surface: Option<&_>| {
                    scene.emitters()[e].model().eval(scene, d, surface)
                };
                paths.f_bsdf[lane] = match hit {
                    Some(hit) => scene
                        .emitter_at(&hit)
                        .map_or(Rgb::ZERO, |e| eval(e, Some(&scene.interaction(ray, &hit)))),
                    None => scene.environments().iter().map(|&e| eval(e, None)).sum(),
                };
                paths.found[lane] = true;
            });
        }
    }
}
