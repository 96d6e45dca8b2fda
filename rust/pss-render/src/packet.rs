//! Sixteen rays on their way to Embree, each with what is to be done when the answer is back.
//!
//! Packets pay for all rays on a processor with wide registers: coherent ones share their traversal, and of the others
//! sixteen are intersected at once where they happen to meet the same nodes (`docs/performance.md`).

use embree4::{Hit, PACKET_WIDTH, Ray};

/// Rays of one kind of query.
pub(crate) struct Packet<T> {
    rays: [Ray; PACKET_WIDTH],
    items: [T; PACKET_WIDTH],
    len: usize,
}

impl<T: Copy + Default> Packet<T> {
    pub(crate) fn new() -> Self {
        Self {
            rays: [Ray::new([0.0; 3], [0.0, 0.0, 1.0]); PACKET_WIDTH],
            items: [T::default(); PACKET_WIDTH],
            len: 0,
        }
    }

    /// Adds a ray; true where the packet is full and must be sent.
    #[inline]
    pub(crate) fn push(&mut self, ray: Ray, item: T) -> bool {
        self.rays[self.len] = ray;
        self.items[self.len] = item;
        self.len += 1;
        self.len == PACKET_WIDTH
    }

    /// The rays so far.
    pub(crate) fn rays(&self) -> &[Ray] {
        &self.rays[..self.len]
    }

    /// Sends the rays and hands out what they met; the packet is empty then.
    #[inline]
    pub(crate) fn intersect(
        &mut self,
        accel: &embree4::Scene,
        coherent: bool,
        mut answer: impl FnMut(T, &Ray, Option<Hit>),
    ) {
        let mut hits = [None; PACKET_WIDTH];
        let (rays, hits) = (&self.rays[..self.len], &mut hits[..self.len]);
        accel.intersect_packet16(rays, hits, coherent);
        for ((item, ray), hit) in self.items.iter().zip(rays).zip(hits) {
            answer(*item, ray, *hit);
        }
        self.len = 0;
    }

    /// Sends the rays as shadow rays and hands out those that nothing blocks; the packet is empty then.
    #[inline]
    pub(crate) fn unoccluded(&mut self, accel: &embree4::Scene, mut answer: impl FnMut(T)) {
        let mut blocked = [false; PACKET_WIDTH];
        let (rays, blocked) = (&self.rays[..self.len], &mut blocked[..self.len]);
        accel.occluded_packet16(rays, blocked, false);
        for (item, blocked) in self.items.iter().zip(blocked) {
            if !*blocked {
                answer(*item);
            }
        }
        self.len = 0;
    }
}
