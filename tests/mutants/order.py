"""Mutants of which worker takes which rays, and in which order."""

from mutant import Mutant

ROOM = "test_kernel_parcels.py::test_there_is_room_for_all_parcels"
SHARED_OUT = "test_kernel_order.py::test_rays_are_shared_out_by_slab_and_work"
WORK = "test_kernel_order.py::test_each_worker_has_as_much_work"
NEAREST = "test_kernel_order.py::test_each_worker_has_the_rays_nearest_its_part_cell_by_cell"
MEETING = "test_parallel.py::test_workers_meet"
MEET = """    if not meet(turn.meeting, n_workers):
        return wp.vec2i(0, 0)
"""
CELL = "test_kernel_order.py::test_cells_are_numbered_along_a_curve"

MUTANTS = [
    Mutant("measure_ray: where rays begin", "order.py", "(ray.begin + ray.end) // 2",
           "ray.begin", NEAREST),
    Mutant("measure_ray: beyond far", "order.py",
           "(ray.begin + ray.end) // 2", "(ray.begin + ray.end)", NEAREST),
    Mutant("measure_ray: not contracted", "order.py",
           "contract(ray.q_origin + t * ray.q_direction, grid.border, contraction)",
           "ray.q_origin + t * ray.q_direction", NEAREST),
    Mutant("measure_ray: half of the grid", "order.py", "real(2.0) * grid.middle",
           "grid.middle", NEAREST),
    Mutant("measure_ray: all alike", "order.py",
           "turn.work[i] = n_packs * wp.static(LANES) +", "turn.work[i] =", WORK),
    Mutant("measure_ray: where rays end", "order.py",
           "(ray.end - ray.begin) //", "ray.end //", WORK),
    Mutant("measure_ray: packs rounded down", "order.py",
           "(ray.end - ray.begin) // wp.static(LANES) + 1",
           "(ray.end - ray.begin) // wp.static(LANES)", ROOM),
    Mutant("cell_at: axes in another order", "order.py",
           "<< (3 * bit + 2 - axis)", "<< (3 * bit + axis)", NEAREST),
    Mutant("cell_at: bits in another order", "order.py",
           "((index >> bit) & 1) <<", "((index >> (BITS - 1 - bit)) & 1) <<", NEAREST),
    Mutant("cell_at: half of the cells", "order.py",
           "real(wp.static(ACROSS))", "real(wp.static(ACROSS // 2))", NEAREST),
    Mutant("cell_at: one less", "order.py",
           "* real(wp.static(ACROSS))", "* real(wp.static(ACROSS - 1))", CELL),
    Mutant("cell_at: beyond the last", "order.py",
           "wp.min(int(scaled), wp.static(ACROSS - 1))", "int(scaled)", CELL),
    Mutant("share_out: cells begin with the first ray", "order.py",
           "    at = int(turn.begin)\n    for cell", "    at = int(0)\n    for cell", SHARED_OUT),
    Mutant("slab_of: along z", "order.py", "(cell >> (3 * bit + 2))", "(cell >> (3 * bit))",
           SHARED_OUT),
    Mutant("share_out: more than there is room for", "order.py",
           "<= turn.most_work", "<= wp.int64(2) * turn.most_work", SHARED_OUT),
    Mutant("share_out: not one ray at least", "order.py", "last == turn.begin or ", "", SHARED_OUT),
    Mutant("share_out: the last turn's work", "order.py",
           "        turn.work_before[slab] = wp.int64(0)\n", "        pass\n", SHARED_OUT),
    Mutant("share_out: the last turn's rays", "order.py",
           "        turn.rays_before[cell] = 0\n", "        pass\n", SHARED_OUT),
    Mutant("share_out: slabs after one's own", "order.py",
           "        turn.work_before[slab] = before\n        before += here\n",
           "        before += here\n        turn.work_before[slab] = before\n", SHARED_OUT),
    Mutant("share_out: cells after one's own", "order.py",
           "        turn.rays_before[cell] = at\n        at += n\n",
           "        at += n\n        turn.rays_before[cell] = at\n", SHARED_OUT),
    Mutant("share_out: rays of a cell on one place", "order.py",
           "        turn.rays_before[turn.cells[i]] = at + 1\n", "", SHARED_OUT),
    Mutant("share_out: rays of one slab all alike", "order.py",
           "        turn.work_before[slab] = before + wp.int64(turn.work[i])\n", "", SHARED_OUT),
    Mutant("share_out: work beyond int", "order.py",
           "before * wp.int64(n_workers) // total",
           "wp.int64(int(before)) * wp.int64(n_workers) // total", SHARED_OUT),
    Mutant("share_out: rays as they come", "order.py",
           "turn.rays[at] = turn.by_cell[place]", "turn.rays[at] = place", SHARED_OUT),
    Mutant("share_out: cursors one late", "order.py",
           "turn.bounds[turn.owners[place] + 1] = at + 1",
           "turn.bounds[turn.owners[place] + 1] = at",
           SHARED_OUT),
    Mutant("take_share: shared out before all rays are measured", "order.py",
           MEET + "    if worker == 0:", "    if worker == 0:", NEAREST),
    Mutant("take_share: taken before they are shared out", "order.py",
           MEET + "    return", "    return", "test_kernel_parcels.py::test_one_thread_against_more"),
    Mutant("meet: nobody waits", "meeting.py", "read(ARRIVED) < all", "false", MEETING),
    Mutant("meet: one does not wait", "meeting.py",
           "read(ARRIVED) < all", "read(ARRIVED) < all - 1", MEETING),
    Mutant("meet: the last meeting's", "meeting.py",
           "(before / n_workers + 1)", "(before / n_workers)", MEETING),
    Mutant("meet: called off, and goes on", "meeting.py", "return false;", "return true;",
           "test_parallel.py::test_nobody_waits_for_who_does_not_come"),
]  # fmt: skip
