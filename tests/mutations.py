"""What tests/mutate.py breaks. A mutation is found by its text, so that it may move within its file."""

from typing import NamedTuple


class Mutation(NamedTuple):
    """One change that a test must notice.

    Attributes:
        breaks: What is wrong with it.
        file: Where.
        old: Text that stands there once.
        new: What takes its place.
        tests: Files of the tests that guard it.
        keyword: Which of their tests, as pytest's -k has it; all if empty.
        origin: "first" for those that a review tried, of which 22 of 45 had survived, else "second".
        equivalent: Why no test can notice it; empty for all others.
    """

    breaks: str
    file: str
    old: str
    new: str
    tests: str
    keyword: str = ""
    origin: str = "first"
    equivalent: str = ""


LCP, SCENES, DATA = "lcplearn/lcp/", "lcplearn/scenes/", "lcplearn/datasets/"
MODELS, TRAINING = "lcplearn/formulations/", "lcplearn/training/"
FIT, METRICS, GRADIENT = "tests/training/test_fit.py", "tests/training/test_metrics.py", "tests/lcp/test_gradient.py"
COMPARE, PREDICT = "tests/training/test_compare.py", "tests/training/test_predict.py"
COMMAND = "tests/training/test_command_line.py"

FIRST = [
    # Those that had survived.
    Mutation("test and validation draw the training data's numbers", DATA + "simulated.py",
             "manual_seed(len(sizes) * seed + number)", "manual_seed(len(sizes) * seed)",
             "tests/datasets/test_simulate.py", "split"),
    Mutation("what sticks: 1e-6 m/s", SCENES + "scene.py", "STICK_SPEED = 1e-12", "STICK_SPEED = 1e-6", METRICS),
    Mutation("loss weights are ignored", TRAINING + "module.py", "[loss[name] * term for",
             "[term for", FIT, "weighted"),
    Mutation("the best model is that of the smallest loss", TRAINING + "module.py",
             "{self.monitor: chosen,", "{self.monitor: self._total(terms),", FIT, "weighted"),
    Mutation("the 90th percentile is the median", TRAINING + "metrics.py", "error.quantile(0.9)", "error.quantile(0.5)",
             METRICS),
    Mutation("rollout_rmse_1000 over 100 steps", TRAINING + "metrics.py", "found.long_recordings, 1000)",
             "found.long_recordings, 100)", METRICS),
    Mutation("unsolved_share is always 0", TRAINING + "metrics.py", "1.0 - float(step.solved.double().mean())",
             "0.0 * float(step.solved.double().mean())", METRICS),
    Mutation("false_stick is over all steps", TRAINING + "metrics.py", "_share(still[~sticks])",
             "_share(still & ~sticks)", METRICS),
    Mutation("a step behind a recording's end counts", DATA + "recordings.py",
             "device=self.steps.device) < self.steps[:, None]", "device=self.steps.device) <= self.steps[:, None]",
             METRICS),
    Mutation("seconds before a resumption are forgotten in metrics", TRAINING + "fitting.py",
             'return before["train_seconds"], {', 'return 0.0, {', FIT, "time_of_training"),
    Mutation("seconds before a resumption are forgotten in checkpoints", TRAINING + "module.py",
             'self.seconds_before = checkpoint["train_seconds"]', "self.seconds_before = 0.0", FIT, "time_of_training"),
    Mutation("last.ckpt is written at the end only", TRAINING + "callbacks.py", " or done % self.every == 0:", ":",
             FIT, "last_ckpt_is_written"),
    Mutation("no cosine decay", TRAINING + "optimizer.py",
             "float(self.lr) * 0.5 * (1.0 + math.cos(math.pi * min(epoch / max(last, 1), 1.0)))",
             "self.lr + 0.0 * last", FIT, "cosine"),
    Mutation("torch's judge sees no single rows", LCP + "residuals.py", "torch.maximum(natural / q_size, rows)",
             "natural / q_size", "tests/lcp/test_residuals.py"),
    Mutation("torch's judge accepts 1e-3", LCP + "residuals.py", "rounding.clamp(max=1e-6)", "rounding.clamp(max=1e-3)",
             "tests/lcp/test_residuals.py"),
    Mutation("a kink is what is small to 1e-3", LCP + "solution.py", "(self.z <= 1e-8 * z_scale)",
             "(self.z <= 1e-3 * z_scale)", "tests/lcp/test_solution.py " + GRADIENT, "kink or degenerate"),
    Mutation("forward mode of an unsolved element is not zero", LCP + "gradient.py",
             "torch.where(solved, dw, 0.0).to(dtype)", "dw.to(dtype)", GRADIENT, "not_solved or unsolved or forward"),
    Mutation("the rank of float64 blocks is that of 1e-3", LCP + "gradient.py", "torch.float64: (EPS, 1e-11)",
             "torch.float64: (EPS, 1e-3)", GRADIENT),
    Mutation("the rank of float32 blocks is that of float64", LCP + "gradient.py", "torch.float32: (1e-7, 1e-5)",
             "torch.float32: (EPS, 1e-11)", GRADIENT),
    Mutation("torch's gradient of an unsolved element is not zero", LCP + "gradient.py",
             "(torch.where(solved, x, 0.0) for x in (grad_z, grad_w, z))", "(x for x in (grad_z, grad_w, z))",
             GRADIENT, "not_solved"),
    Mutation("the kernel's judge accepts 1e-3", LCP + "kernel/judging.py", "max(tol, min(1e-6,", "max(tol, min(1e-3,",
             "tests/lcp/test_residuals.py"),
    Mutation("a certificate may be wrong by 1e-3", LCP + "kernel/lemke.py", "proven and total <= 1e-12 * size",
             "proven and total <= 1e-3 * size", "tests/lcp/test_pivoting.py"),
    # Those that had been caught.
    Mutation("the adjoint has the wrong sign", LCP + "gradient.py", "rhs = -g_z - multiply(M.mT, h_I)",
             "rhs = g_z - multiply(M.mT, h_I)", GRADIENT, "finite_differences"),
    Mutation("the adjoint's block is not transposed", LCP + "gradient.py", "K = M.mT\n", "K = M\n", GRADIENT,
             "finite_differences or kernel_equals"),
    Mutation("the nonbasic part is not transposed", LCP + "gradient.py", "multiply(M.mT, h_I)", "multiply(M, h_I)",
             GRADIENT, "finite_differences or kernel_equals"),
    Mutation("smoothing adds nothing to the diagonal", LCP + "gradient.py", "K + torch.diag_embed(damping), rhs",
             "K + 0.0 * torch.diag_embed(damping), rhs", GRADIENT, "smoothed"),
    Mutation("forward mode forgets dM", LCP + "gradient.py",
             "e = e + torch.where(solved, multiply(dM.double(), z), 0.0)", "e = e + 0.0", GRADIENT, "forward"),
    Mutation("windows end one step late", DATA + "recordings.py", "recordings.steps[:, None] - k).clamp",
             "recordings.steps[:, None] - k + 1).clamp", "tests/datasets/test_windows.py"),
    Mutation("windows have the force of the next step", DATA + "recordings.py",
             "instants[:, :-1].clamp(max=horizon - 1)",
             "instants[:, 1:].clamp(max=horizon - 1)", "tests/datasets/test_windows.py"),
    Mutation("slides are one step too long", DATA + "cube_slides.py", "[len(slide) - 1 for slide in slides]",
             "[len(slide) for slide in slides]", "tests/datasets/test_cube_slides.py " + PREDICT, "slides"),
    Mutation("validation slides are tested on", DATA + "cube_slides.py", "slides[training_slides:])",
             "slides[learning:])", "tests/datasets/test_cube_slides.py"),
    Mutation("the sliding block's test is noisy", DATA + "simulated.py",
             'exact = self.name.startswith("test")', "exact = False", "tests/datasets/test_simulate.py"),
    Mutation("positions do not move on", MODELS + "line/formulation.py",
             "torch.stack((position + self.dt * velocity, velocity), dim=-1)",
             "torch.stack((position, velocity), dim=-1)",
             "tests/formulations/test_formulations.py"),
    Mutation("mu is read out without the mass", MODELS + "line/structured.py",
             "(self.log_a + self.log_c).exp().item()", "self.log_c.exp().item()",
             "tests/formulations/test_formulations.py tests/formulations/test_learning.py"),
    Mutation("mass is read out as its inverse", MODELS + "line/structured.py", "= 1.0 / b_u",
             "= b_u", "tests/formulations/test_formulations.py tests/formulations/test_learning.py"),
    Mutation("padding counts in the loss", MODELS + "losses.py", "/ valid.sum().clamp(min=1)", "/ valid.numel()",
             "tests/formulations/test_losses.py"),
    Mutation("the violation's friction is not limited", SCENES + "violation.py",
             "torch.where(inside.abs() <= limit, inside, beyond)", "inside + 0.0 * beyond",
             "tests/formulations/test_losses.py"),
    Mutation("the last parameters are taken, not the best", TRAINING + "fitting.py",
             'module.load_state_dict(checkpoint["state_dict"])', "pass", FIT, "best_model_before"),
    Mutation("early stopping ends before LBFGS has begun", TRAINING + "callbacks.py",
             "optimizer.lbfgs_after is None or optimizer.finishes(epoch)", "True", FIT, "early"),
    Mutation("another loss is resumed in silence", TRAINING + "checkpoint.py",
             'if before != ours["objective"][name]:', "if False:", FIT, "foreign"),
    Mutation("batches are not shuffled", TRAINING + "fitting.py", "shuffle=batch_size is not None", "shuffle=False",
             FIT, "equal_seeds"),
    Mutation("a row shows its best seed", "lcplearn/compare.py", "statistics.median if finite else middle",
             "min if finite else middle", COMPARE),
    Mutation("motion's time starts at the first step", TRAINING + "motion.py",
             "np.arange(positions.shape[-2]) * model.dt", "(1 + np.arange(positions.shape[-2])) * model.dt",
             PREDICT, "csv_prediction"),
    Mutation("the summary's worst residual is the best", LCP + "solution.py", "float(solved.max())",
             "float(solved.min())", "tests/lcp/test_solution.py"),
    Mutation("nothing is proved to be infeasible", LCP + "kernel/lemke.py", "proven = qu <= -margin * size",
             "proven = qu < -1e300 * size", "tests/lcp/test_solution.py"),
]

SECOND = [
    Mutation(*each, origin="second")  # type: ignore[arg-type]
    for each in [
        ("Coulomb's limit is twice as large", SCENES + "sliding_block.py",
         "limit = self.mu * self.mass * self.gravity\n",
         "limit = 2 * self.mu * self.mass * self.gravity\n", "tests/scenes/test_sliding_block.py"),
        ("a block that rests slips", SCENES + "sliding_block.py", "torch.where(velocity == 0, int(Mode.STICK)",
         "torch.where(velocity != 0, int(Mode.STICK)", "tests/scenes/test_sliding_block.py"),
        ("ReLU does not start mirrored", MODELS + "line/relu.py", "output.weight[1] = -output.weight[0]", "pass",
         "tests/formulations/test_formulations.py tests/formulations/test_learning.py"),
        ("a ramp of friction labels: slack is the limit less", DATA + "simulate.py", 'return slack if kind == "slack"',
         'return slack if kind == "lcp"', "tests/datasets/test_simulate.py"),
        ("a share of ranks sees the same windows", DATA + "loader.py",
         "torch.arange(rank, taken, world_size)", "torch.arange(0, taken, world_size)",
         "tests/datasets/test_windows.py"),
        ("each epoch has the same order", DATA + "loader.py", "1_000_003 * self.epoch", "0 * self.epoch",
         "tests/datasets/test_windows.py"),
        ("checkpoints are written in place", DATA + "files.py", 'beside = path.with_name(f".{path.name}.part")',
         "beside = path", FIT, "written_whole"),
        ("last.ckpt is written before the best score is known", TRAINING + "callbacks.py",
         ", save_on_train_epoch_end=False", "", FIT, "last_ckpt_is_written"),
        ("a diverged training goes on", TRAINING + "callbacks.py", "        if not diverged:\n", "        if True:\n",
         FIT,
         "diverges"),
        ("another seed is resumed in silence", TRAINING + "checkpoint.py", "if changed and not allow_changes:",
         "if False:", FIT, "refused_by_name"),
        ("the data's fingerprint is that of anything", TRAINING + "asked.py",
         "digest.update(tensor.detach().cpu().numpy().tobytes())", "pass", FIT, "refused_by_name"),
        ("any module is imported", TRAINING + "checkpoint.py", "not (trust or module in sys.modules or",
         "not (True or module in sys.modules or", PREDICT, "trusted"),
        ("NaN parameters are loaded", TRAINING + "checkpoint.py", "    if wrong:\n", "    if False:\n",
         PREDICT, "not_finite"),
        ("a diverged run is left out of its row", "lcplearn/compare.py",
         "[worst if value is None or math.isinf(value) else value for value in found]",
         "[value for value in found if value is not None and not math.isinf(value)]", COMPARE),
        ("runs of other epochs share a row", "lcplearn/compare.py",
         '"trainer.enable_progress_bar"', '"trainer."', COMPARE),
        ("one seed twice is two seeds", "lcplearn/compare.py", "len(runs), len(seeds)", "len(runs), len(runs)",
         COMPARE),
        ("an input's time step is not looked at", "lcplearn/predict.py",
         "if inputs.dt is not None and abs(inputs.dt / model.dt - 1.0) > 1e-4:", "if False:",
         PREDICT, "time_step or sentence"),
        ("surplus cells are dropped", DATA + "inputs.py", "if len(cells) != len(header):",
         "if len(cells) < len(header):", PREDICT, "wrong_input_file"),
        ("forces [T, 1] are T trajectories", DATA + "inputs.py",
         "if space.nv == 1 and not (forces.ndim > 1 and forces.shape[-1] == 1):",
         "if space.nv == 1:", PREDICT,
         "last_axis"),
        ("a folder is used twice", "lcplearn/command_line.py", "            chosen.mkdir()\n",
         "            chosen.mkdir(exist_ok=True)\n", COMMAND, "taken or second"),
        ("a mistake leaves its folder", "lcplearn/command_line.py", "shutil.rmtree(folder)\n        return",
         "return", COMMAND, "latest"),
        ("the mean of a pair of diverged and finite counts", "lcplearn/compare.py",
         "statistics.median_low if worst < 0 else statistics.median_high",
         "statistics.median_high if worst < 0 else statistics.median_low", COMPARE),
        ("an island's proof is laid on other rows", LCP + "kernel/islands.py", "us[i] = u[a] if",
         "us[a] = u[a] if", "tests/lcp/test_islands.py"),
        ("pivots of islands are not added up", LCP + "kernel/islands.py", "used += ended[2]", "used = ended[2]",
         "tests/lcp/test_islands.py"),
        ("single rows need no pivot of the budget", LCP + "kernel/islands.py", "if not easy and budget == 0:",
         "if False:", "tests/lcp/test_islands.py"),
        ("rows connect only with the first one", LCP + "kernel/islands.py", "M[i, j] != 0.0 and other != own:",
         "M[i, j] != 0.0 and other != own and i == 0:", "tests/lcp/test_islands.py"),
        ("islands start from no basis", LCP + "kernel/islands.py", "basis[a] = bases[rows[a]]", "basis[a] = False",
         "tests/lcp/test_islands.py"),
        ("slices of a sum depend on the threads", LCP + "threads.py", "not helpers and not summed and",
         "not helpers and", "tests/lcp/test_threads.py"),
        ("a thread that can't be started takes a slice with it", LCP + "threads.py",
         "pool.shutdown(cancel_futures=True)", "pass", "tests/lcp/test_threads.py"),
        ("a forked process waits for its parent's threads", LCP + "threads.py",
         "os.register_at_fork(after_in_child=_pool.cache_clear)", "pass", "tests/lcp/test_threads.py"),
        ("small work wakes threads", LCP + "threads.py", "WORTHWHILE = 0.5e-3", "WORTHWHILE = 0.5e-5",
         "tests/lcp/test_threads.py"),
        ("rows and columns scaled apart are found late", LCP + "kernel/cascade.py", "if scaled_apart:", "if False:",
         "tests/lcp/test_cascade.py"),
        ("few pivot on the diagonal", LCP + "kernel/cascade.py", "or (n < 16 and i == 0)", "",
         "tests/lcp/test_cascade.py"),
        ("what has zeros on its diagonal pivots there", LCP + "kernel/cascade.py",
         "while i > 0 and M[i - 1, i - 1] > 0.0:", "while i > 0:", "tests/lcp/test_cascade.py"),
        ("a solution of denormal size is judged by shares of it", LCP + "kernel/judging.py",
         "lost = 0.0 < z_size < TINY", "lost = False", "tests/lcp/test_pivoting.py", "too_small"),
        ("the last vector of a row holds the next row", LCP + "kernel/square.py",
         "return self.keep(self.mask, self.v.load(self.builder.select(row[2], self.rest, inside)))",
         "return self.v.load(self.builder.select(row[2], self.rest, inside))", "tests/lcp/test_kernel_vectors.py"),
    ]
]  # fmt: skip

MUTATIONS = [*FIRST, *SECOND]
