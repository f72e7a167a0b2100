"""The lines that `mutants.py` breaks, and the tests that shall notice."""

# (file below minislam/, test files below tests/): what it says, what the mutant says
MUTANTS: dict[tuple[str, str], list[tuple[str, str]]] = {
    ("cli/main.py", "cli/test_main.py"): [
        (', "TRIM_THRESHOLD_": (-1, 64 << 20)', ""),
        ('os.environ[f"MALLOC_{name}"] = str(value)', "pass"),
        ('if f"MALLOC_{name}" not in os.environ:', "if True:"),
    ],
    ("geometry/se3.py", "geometry/test_se3.py"): [
        ("-(rotation_t @ transforms", "(rotation_t @ transforms"),
        ("aw * by - ax * bz", "aw * by + ax * bz"), ("1.5 * eye - 0.5 *", "1.5 * eye - 0.4 *"),
        ("torch.where(q[..., :1] < 0, -q, q)", "q"),
    ],
    ("geometry/camera.py", "geometry/test_camera.py"): [
        ("min((self.cx + 0.5) * sx, width) - 0.5", "self.cx * sx"),
        ("fx * (1 + a * a)", "fx * (1 - a * a)"), ("self.cx - left", "self.cx + left"),
        ("u <= self.width - 1", "u <= self.width"),
    ],
    ("geometry/alignment.py", "geometry/test_alignment.py"): [
        ("signs[2] = -1.0", "signs[2] = 1.0"), ("target_mean - scale *", "target_mean -"),
    ],
    ("uncertainty/weights.py", "uncertainty/test_weights.py"): [
        ("1 / 0.8 - 2", "1 / 0.8 + 2"), (".clamp_max(TRACKING_CAP)", ""),
        ("torch.where(weight < least", "torch.where(weight > least"),
        ("weight.quantile(1 - STATIC_FRACTION)", "weight.quantile(STATIC_FRACTION)"),
        ("(weight / weight.quantile(1 - STATIC_FRACTION))", "weight"),
    ],
    ("uncertainty/losses.py", "uncertainty/test_losses.py"): [
        ("contrast.clamp_max(STRUCTURE_CAP)", "contrast"),
        ("opacity >= SURFACE_OPACITY", "opacity >= 0"), ("& (reference_depth < far_limit)", ""),
        ('mode="reflect"', 'mode="constant"'), ("/ beta**2 +", "/ beta +"),
    ],
    ("mapping/window.py", "mapping/test_window.py"): [
        ("min(int(seen_a.sum()), ", "max(int(seen_a.sum()), "),
        ("leaving[-1]", "leaving[0]"),
        ("crowding = candidates.sum(-1)", "crowding = -candidates.sum(-1)"),
        ("(1 - window_probability) / (", "window_probability / ("),
    ],
    ("mapping/insertion.py", "mapping/test_insertion.py"): [
        ("& (weight > 0)", ""), ("opacity < EXPLAINED_OPACITY", "opacity > EXPLAINED_OPACITY"),
        ("& (sides == side)", ""), ("known & (s", "(s"), ("amax(0) < plain", "amax(0) < 9"),
        ("] * z / focal", "] / focal"), ("SURFACE * lowest[3]", "9"), ("(z > 0) & (we", "(we"),
    ],
    ("mapping/losses.py", "mapping/test_losses.py"): [
        ("slopes * (v_loss / -len(x))", "slopes * (v_loss / len(x))"),
        ("image.sum(-1) > BLACK", "image.sum(-1) >= 0"), ("in_front & (opacity", "(opacity"),
        ("(scales - scales.mean(-1, keepdim=True))", "scales"),
    ],
    ("mapping/mapper.py", "mapping/test_mapper.py"): [("if not image.inserts", "if False")],
    ("mapping/gaps.py", "mapping/test_gaps.py"): [
        ("mean / np.maximum(covered, 1e-6)", "mean"), ("math.sqrt(2) * down(1)", "down(1)"),
        ("inside & (beyond >", "(beyond >"), ("inside & (beyond.abs()", "(beyond.abs()"),
        ("math.ceil(len(images) / VOTERS)", "1"), ("votes -=", "votes +="),
        ("is_guessed & ((depth_votes", "((depth_votes"), ("> 0) | is_near", "> 0)"),
        ("inside & (z < MUCH_NEARER", "(z < MUCH_NEARER"), ("votes > 0) & (d", "votes > 0) | (d"),
    ],
    ("mapping/mapper.py", "mapping/test_gaps.py"): [
        ("self._insert(position, fills=True)", "self._insert(position)"),
        ("keep(~is_refuted(new.means, new.colors, self.camera, image, self.images))", "detach()"),
    ],
    ("mapping/safeguards.py", "mapping/test_mapper.py"): [
        (".detach()[static] > OPAQUE", ".detach()[weight > -1] > OPAQUE"),
        (".detach()[static] > OPAQUE", ".detach()[static] < OPAQUE"), ("(len(gaussians) > 0)", "1"),
    ],
    ("runs/warnings.py", "runs/test_warnings.py runs/test_run_ending.py"): [
        ("shown is not None and shown < LEAST_SHOWN", "bool(shown) and shown < LEAST_SHOWN"),
        ("np.argmin(slam.mapper.shown)", "np.argmax(slam.mapper.shown)"),
    ],
    ("tracking/initialisation.py", "tracking/test_initialisation.py"): [
        ("(below, -right, right)", "(-below, -right, right)"),
    ],
    (
        "tracking/initialisation.py",
        "tracking/safeguards/test_first_camera.py",
    ): [("replace(chain, log_focal=log_focal)", "chain")],
    ("tracking/safeguards/first_camera.py", "tracking/safeguards/test_first_camera.py"): [
        ("> SAME_COST * cost_of(one)", "> SAME_COST"),
        ("for log in OTHER_FOCALS", "for log in ()"),
        ("saving <= FOCAL_WORTH_SAVING", "False"),
        ("edge_columns(self.positions) if self.tells_camera", "None if self.tells_camera"),
        ("(1 - READOUT_WORTH_SAVING) * min", "2 * min"),
        ("self.problem = bundle_problem(self.graph, self.positions)  # of the", "pass  # of the"),
        ("* doublings - RELIEF", "* doublings + RELIEF"),
        ("abs(state.log_focal) / math.log(2)", "state.log_focal / math.log(2)"),
        ("return math.inf", "return 0.0"),
        ("usual, cells = known_disparities.log(), known", "pass"),
    ],
    ("tracking/safeguards/rolling_shutter.py", "tracking/safeguards/test_rolling_shutter.py"): [
        ("self._grid.camera.width < self", "self._grid.camera.width > self"),
        ("self.is_found = True", "pass"), ("        self.lengthen(found)", "        pass"),
    ],
    ("tracking/safeguards/focal_length.py", "tracking/safeguards/test_focal_length.py"): [
        ("(free, start or state)", "(free, state)"),
    ],
    ("tracking/bundle_adjustment.py", "tracking/test_bundle_adjustment_steps.py"): [
        ("next_cost <= cost", "next_cost <= 1.001 * cost"),
    ],
    ("tracking/bundle_adjustment.py",
     "tracking/test_bundle_adjustment_steps.py tracking/test_bundle_adjustment.py"): [
        ("max(level / 10, damping)", "damping"),
    ],
    ("tracking/safeguards/robust.py", "tracking/safeguards/test_robust.py"): [
        ("-self.power", "-1"), ("self.scale**2 * torch.log1p", "torch.log1p"),
        ("max(residual, MIN_RESIDUAL)", "residual"), ("min(width, self.scale)", "width"),
    ],
    ("tracking/optimisation.py", "tracking/test_optimisation.py"): [
        ("settled=is_last", "settled=True"), ("(sample) >= ENOUGH", "(sample) < ENOUGH"),
        ("0, len(problem.rays), EVERY", "0, len(problem.rays) // 2, EVERY"),
        ("lengths(residual), weights[:, 0]", "lengths(residual), 1 + 0 * weights[:, 0]"),
        ("static[:, None]", "of_cell[source][:, None]"),
    ],
    ("tracking/safeguards/motion_memory.py", "tracking/safeguards/test_motion_memory.py"): [
        ("LOSS_RATE, RECOVERY_RATE)", "RECOVERY_RATE, LOSS_RATE)"), ('"amin"', '"amax"'),
        ("+ DEPTH_ERROR**2 * parallax", ""),
    ],
    ("tracking/safeguards/settling.py", "tracking/safeguards/test_settling.py"): [
        ("information > SETTLED", "information < SETTLED"), (".clamp_min(LEAST)", ""),
    ],
    ("tracking/safeguards/scale_certainty.py", "tracking/safeguards/test_scale_certainty.py"): [
        ("LEAST_C * C[C > 0].mean()", "0"), ("HOLD = 1e-8", "HOLD = 1e-6"),
        ("LEAST_C = 1e-6", "LEAST_C = 1e-2"), ("(1 + HOLD)", "1"),
        ("gradient[end, :3] -=", "gradient[end, :3] +="), (".square().sum(0)", ".abs().sum(0)"),
        ("(weights * residual.square()).sum()", "residual.square().sum()"),
        ("row[end].square()", "row[end]"), ("diagonal(REACH)", "diagonal(1)"),
        ("before[-1], -1", "before[0], -1"), ("{} if failure else dict", "dict"),
        ("and usual > 0", ""),
    ],
    ("tracking/schur.py", "tracking/test_schur.py tracking/safeguards/test_parts.py"): [
        ("-(scaled @ E.mT)", "(scaled @ E.mT)"), ("-(scaled @ equations", "(scaled @ equations"),
        ("if slots[source] >= 0 else []", "if True else []"),
    ],
    ("tracking/safeguards/scale_drift.py", "tracking/safeguards/test_scale_drift.py"): [
        ("(-drift).exp()", "drift.exp()"), ("+ drift[:-1]) / 2).exp()", "- drift[:-1]) / 2).exp()"),
        ("drift - drift.mean()", "drift"), ("SLOW_ERROR**2 + (noise", "0 * (noise"),
        ("+ information.log()", ""), ("(length / before)", "(before / length)"),
        ("-0.5 * ((position", "-5.0 * ((position"), ("length**4 /", "length**2 /"),
    ],
    ("tracking/safeguards/motion_memory.py",
     "tracking/safeguards/test_motion_memory_overlay.py"): [
        ("counts & (flow < STANDS)", "flow < STANDS"),
        ("> MOVES", "> 0"), (">= ALWAYS", "> 0"), ("len(still) < MIN_PAIRS", "not still"),
        ("2 * REACH + 1, 1, REACH", "REACH + 1, 1, REACH // 2"), ("* of_matched /", "/"),
        ("matches.confidences * overlay", "matches.confidences * (1 - overlay)"),
    ],
    ("tracking/initialisation.py", "tracking/test_tracker_overlay.py"): [
        ("[motion_memory.without_overlay(matches, overlay) for matches", "[matches for matches"),
    ],
    ("tracking/tracker.py", "tracking/test_tracker_overlay.py"): [
        ("motion_memory.without_overlay(matches, self.keyframes.overlay)", "matches"),
    ],
    ("tracking/safeguards/pose_support.py", "tracking/safeguards/test_pose_support.py"): [
        ("fits[index].support < LOST_SUPPORT", "fits[index].support < 0 *"),
        ("key=lambda fit: fit.support", "key=lambda fit: -fit.support"),
    ],
    ("tracking/safeguards/first_frame.py", "tracking/safeguards/test_first_frame.py"): [
        ("lost >= len(followed)", "lost > len(followed)"),
    ],
    ("mapping/safeguards.py", "mapping/test_safeguards.py"): [
        ("[static].sum()", ".sum()"), ("[static].sum()", "[~static].sum()"),
        ("opacity >= SURFACE_OPACITY", "opacity >= 0"), (">= LEAST_WRONG", "> LEAST_WRONG"),
    ],
    ("mapping/mapper.py", "mapping/test_safeguards.py"): [
        ("static.any() and ", ""), ("self._remove_unsupported()", "pass"),
        ("static > safeguards.LEAST_STATIC * total", "static >= safeguards.LEAST_STATIC * total"),
    ],
    ("tracking/keyframe_selection.py", "tracking/test_keyframe_selection.py"): [
        ("if not graph.keyframes.has_prior", "if True"),
        ("if before else flow", "if before else 0.0"), ("-= step / 2", "-= step"),
        ("flow - mean_flow(graph, before[1])", "flow"),
    ],
    ("tracking/safeguards/diagnostics.py", "tracking/safeguards/test_diagnostics.py"): [
        ("weak >= LONG or _is", "_is"), ("find_breaks(judged)", "find_breaks(self.diagnostics)"),
        ("if all(k.parallax <", "if any(k.parallax <"), ("max(found, key", "min(found, key"),
        (">= LEAST_BEYOND_TURNS and not graph", ">= 0 and not graph"),
        ("and not graph.keyframes.has_prior", ""), ("is_tied and has_scale", "is_tied"),
        ("(k, depth_error=None, ", "(k, explained=None, depth_error=None, "),
        ("depth_error=None, continuity=None", "depth_error=None"), ("or held < MIN_CONTINUITY", ""),
        ("max(holding) / max(confidence, 1e-6)", "max(holding)"),
        ("max(LEAST_CELLS, MIN_EVIDENCE * len(matched))", "MIN_EVIDENCE * len(matched)"),
        ("or agreement < MIN_AGREEMENT", ""), ("matched * fits[i, keyframe]", "matched"),
        ("known[i] * static", "static"), ("start - last <=", "index - last <="),
        ("fitted * graph.keyframes.motion_weights[i]", "fitted"),
        ("* static * graph", "* graph"), ("static / static.max().clamp_min(1e-6)", "static"),
        ("max(holding)", "min(holding)"), ("min(agreeing,", "max(agreeing,"),
        ("start - last <= HEALED_AFTER", "False"), ("counted * expected)", "counted)"),
    ],
    ("tracking/safeguards/turns.py", "tracking/safeguards/test_turns.py"): [
        ("free_focal=graph.seeks_focal and", "free_focal=False and"),
        ("graph.seeks_focal and not graph.focal_is_free", "graph.seeks_focal"),
        ("if target == source + 1", "if target == source - 9"),
        ("turned, POSE_ITERATIONS", "turned, 0"),
        ("for kernel in (None, *kernels)", "for kernel in (None,)"),
        ("BundleState(poses, grid.rays.new_zeros(", "BundleState(poses, grid.rays.new_ones("),
        ("/ graph.pixel_scale if known", "if known"),
        (".contains(positions.mT))).amax(0)", ".contains(positions.mT))).amin(0)"),
        ("(valid & graph.grid.camera.contains(positions.mT))", "valid"),
        ("if source == keyframe]\n    if not", "if target == keyframe]\n    if not"),
        ("poses[:, :3, 3] = 0", "pass"), ("0 * keyframes.disparities", "keyframes.disparities"),
        ("if report.converged", "if True"),
    ],
    ("tracking/safeguards/diagnostics.py", "tracking/safeguards/test_turns.py"): [
        ("            return True", "            pass"),
        ("rests or self.confirmed < LEAST_CONFIRMED", "rests"), ("(rests or self", "(self"),
        ("= self.hardly_walked and (", "= ("), (" and len(self.diagnostics) == 2", ""),
        ("self.beyond_turns is not None and", "self.beyond_turns is None or"),
    ],
    ("slam.py", "test_slam_at_rest.py"): [
        ("if not self.tracker.watch.only_turned", "if True"),
        ("enabled and self.tracker.knows_depth", "enabled"),
    ],
    ("tracking/tracker.py", "test_slam_at_rest.py"): [("if not self.knows_depth", "if False")],
    ("tracking/disparity_prior.py", "tracking/test_disparity_prior.py"): [
        ("(depth > 0) & (warped > 0)", "(warped > 0)"), ('"amin"', '"amax"'),
        ("(consistent < ", "(consistent <= "),
    ],
    ("tracking/frame_graph.py", "tracking/test_frame_graph.py"): [
        ("(without_rotation, 1 - full_flow_weight)", "(without_rotation, full_flow_weight)"),
        ("min(abs(i - j) - 2, suppression)", "suppression"), ("ratio >= KEPT", "0 >= -KEPT"),
    ],
    ("tracking/reprojection.py", "tracking/safeguards/test_turns.py"): [
        ("torch.zeros_like(disparities), rays, camera)", "disparities, rays, camera)"),
    ],
    ("stereo/aggregation.py", "stereo/test_aggregation.py"): [
        ("before + STEP_COST", "before"), ("0.5 * (left - right)", "0.5 * (right - left)"),
    ],
    ("stereo/dense_structure.py", "stereo/test_dense_structure.py"): [
        (".clip(FARTHEST * step)", ".clip(0)"), ("are_alike & (", "("),
        ("(best == 0) & (at_best >= votes.CONFIRMING_COST)", "best < 0"),
    ],
    ("stereo/second_adjustment.py", "stereo/test_second_adjustment.py"): [
        ("(depth > 0).float().mean()", "(depth >= 0).float().mean()"),
    ],
    ("workers.py", "test_workers.py"): [("islice(left, AT_ONCE)", "islice(left, None)")],
    ("splatting/tiles.py", "splatting/test_tiles.py"): [
        ("if high.any()", "if False"), ("keys & 0xFFFF", "keys & 0x7FFF"),
        ('high[order].argsort(kind="stable")', "high[order].argsort()"),
        ("bisect_right(lengths, first)", "bisect_right(lengths, first + slots)"),
        ("bisect_right(lengths, first)", "0"),
        ("-(-active // ACTIVE) * ACTIVE", "active // ACTIVE * ACTIVE"),
    ],
    ("splatting/compositing.py", "splatting/test_compositing.py"): [
        ("f_before[-tiles:] = f[-1]", "f_before[-tiles:] = 0"),
        ("T_before.copy_(T.slots[-1])", "T_before.copy_(T.slots[0])"),
        ("strict=True))[::-1]", "strict=True))"), ("v_out_t[-tiles:]", "v_out_t[:tiles]"),
        ("A[-tiles:], gains", "A[:tiles], gains"),
    ],
    ("tracking/bundle_adjustment.py", "tracking/safeguards/test_parts.py"): [
        ("_cost(problem, state, costs)", "_cost(problem, state, costs[:1])"),
    ],
    ("tracking/safeguards/revisits.py", "tracking/safeguards/test_revisits.py"): [
        ("missed <= MOST_DRIFT * walked and ", ""), ("old + 1 :] /= gr", "old + 1 :] *= gr"),
    ],
    ("stereo/votes.py", "stereo/test_votes.py"): [
        ("expected - 2 * tolerance", "expected"), ("& (other.cost.take(place) < WELL_MATCHED)", ""),
        ("known &= _distance(", "known |= _distance("),
    ],
    ("evaluation/images.py", "evaluation/test_images_separability.py"): [
        ('("left", "right")', '("left", "left")'),
    ],
    ("evaluation/images.py", "evaluation/test_images_depth.py"): [
        ("scale * depth - reference", "depth - reference"),
    ],
    ("evaluation/trajectory.py", "evaluation/test_trajectory.py"): [
        ("<= max_difference", "<= 2 * max_difference"),
    ],
    ("data/raw_images.py", "data/test_raw_images.py data/test_sequence.py"): [
        ("if index not in self.odd", ""), ("if change < SIMILAR", "if True"),
        ("self.promised > len(self) > 1", "len(self) > 1"),
        ("0 if len(stamps) == limit else promised", "promised"),
        ("index & (index - 1) == 0", "index == 0"),
    ],
    ("data/picture.py", "data/test_picture.py"): [
        ("> BLACK", "> 0"), ("first + BLURRED * (first > 0)", "first"), ("is_steady and", ""),
        ("LEAST_PICTURE * side", "0 * side"), ("FADED *", "0 *"), ("best - ", "best + 0 *")],
    ("data/preparation.py", "data/test_preparation.py"): [
        ("(*self._maps, self._window)", "(*self._maps, (0, 0, *self._raw_size))"),
        ("map_y > bottom - 1", "map_y > height - 1")],
    ("data/checkpoint.py", "data/test_checkpoint.py"): [("allow_pickle=False", "allow_pickle=1")],
    ("data/run_folder.py", "data/test_run_folder.py"): [("fcntl.LOCK_EX |", "fcntl.LOCK_SH |")],
    ("runs/run.py", "runs/test_run_ending.py"): [
        (": slam.lost_frames(),", ": 0,"), (": slam.tracker.watch.breaks,", ": 0,"),
        ("2 * graph.failed_adjustments >", "graph.failed_adjustments >"),
    ],
    ("runs/measures.py", "runs/test_measures.py"): [
        ("if index not in seen", "if index in seen"),
        ("image.exposed(rendering.color), image.image", "rendering.color, image.image"),
        ("image.image, static\n", "image.image, None\n"),
        ("if static.any() else None", "if True else None"),
    ],
    ("runs/warnings.py", "runs/test_warnings.py"): [
        ("(frames) > gap", "(frames) >= gap"), ("first + 1 >= slam", "first >= slam"),
        ("gap = slam.config.tracking.warmup_keyframes", "gap = 1"),
        ("2 * without >= len", "2 * without < len"), ("and not is_broken", "or is_broken"),
    ],
    ("viz/pages.py", "viz/test_pages_report.py"): [
        ("name: escape(getattr(report, name))", "name: getattr(report, name)"),
        ('class="warning">{escape(text)}', 'class="warning">{text}'),
    ],
}  # fmt: skip
