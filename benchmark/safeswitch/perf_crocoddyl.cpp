// crocoddyl's SolverBoxDDP on the expert's own problem, for `safeswitch.perf`.
//
// The action model calls C code that CasADi generated from the same dynamics and residuals as the expert's solver:
// perf_calc(x, u, p) -> (next x, cost) and perf_diff(x, u, p) -> (Fx, Fu, Lx, Lu, Lxx, Luu, Lxu), perf_end_* for the
// terminal cost. Both solvers therefore minimise the same function with the same Gauss-Newton Hessians.

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <initializer_list>
#include <memory>
#include <stdexcept>
#include <vector>

#include "crocoddyl/core/action-base.hpp"
#include "crocoddyl/core/optctrl/shooting.hpp"
#include "crocoddyl/core/solvers/box-ddp.hpp"
#include "crocoddyl/core/states/euclidean.hpp"

#define GENERATED(name)                                                              \
  extern "C" int name(const double**, double**, long long int*, double*, int);      \
  extern "C" int name##_work(long long int*, long long int*, long long int*, long long int*);
GENERATED(perf_calc)
GENERATED(perf_diff)
GENERATED(perf_end_calc)
GENERATED(perf_end_diff)

namespace {

using Data = std::shared_ptr<crocoddyl::ActionDataAbstract>;
using Vector = Eigen::Ref<const Eigen::VectorXd>;

// A generated function with its scratch memory.
class Generated {
 public:
  using Call = int (*)(const double**, double**, long long int*, double*, int);
  using Work = int (*)(long long int*, long long int*, long long int*, long long int*);

  Generated(Call call, Work work) : call_(call) {
    long long int arguments, results, integers, reals;
    work(&arguments, &results, &integers, &reals);
    arguments_.resize(arguments + 4);
    results_.resize(results + 8);
    integers_.resize(integers + 1);
    reals_.resize(reals + 1);
  }

  void operator()(std::initializer_list<const double*> in, std::initializer_list<double*> out) {
    std::copy(in.begin(), in.end(), arguments_.begin());
    std::copy(out.begin(), out.end(), results_.begin());
    call_(arguments_.data(), results_.data(), integers_.data(), reals_.data(), 0);
  }

 private:
  Call call_;
  std::vector<const double*> arguments_;
  std::vector<double*> results_;
  std::vector<long long int> integers_;
  std::vector<double> reals_;
};

class GeneratedAction : public crocoddyl::ActionModelAbstract {
 public:
  GeneratedAction(std::size_t nx, std::size_t nu, const double* lo, const double* hi, const double* parameters)
      : crocoddyl::ActionModelAbstract(std::make_shared<crocoddyl::StateVector>(nx), nu), parameters_(parameters) {
    set_u_lb(Eigen::Map<const Eigen::VectorXd>(lo, nu));
    set_u_ub(Eigen::Map<const Eigen::VectorXd>(hi, nu));
  }

  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override {
    return std::make_shared<GeneratedAction>(*this);
  }
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override {
    throw std::runtime_error("the generated functions take doubles");
  }

  void calc(const Data& data, const Vector& x, const Vector& u) override {
    calc_({x.data(), u.data(), parameters_}, {data->xnext.data(), &data->cost});
  }
  void calcDiff(const Data& data, const Vector& x, const Vector& u) override {
    diff_({x.data(), u.data(), parameters_},
          {data->Fx.data(), data->Fu.data(), data->Lx.data(), data->Lu.data(), data->Lxx.data(), data->Luu.data(),
           data->Lxu.data()});
  }
  void calc(const Data& data, const Vector& x) override { end_calc_({x.data(), parameters_}, {&data->cost}); }
  void calcDiff(const Data& data, const Vector& x) override {
    end_diff_({x.data(), parameters_}, {data->Lx.data(), data->Lxx.data()});
  }

 private:
  const double* parameters_;
  Generated calc_{perf_calc, perf_calc_work}, diff_{perf_diff, perf_diff_work};
  Generated end_calc_{perf_end_calc, perf_end_calc_work}, end_diff_{perf_end_diff, perf_end_diff_work};
};

struct Solver {
  std::size_t nx, nu, horizon;
  std::vector<double> parameters;
  std::shared_ptr<crocoddyl::ShootingProblem> problem;
  std::unique_ptr<crocoddyl::SolverBoxDDP> ddp;
};

}  // namespace

extern "C" {

void* croco_make(int nx, int nu, int np, int horizon, const double* lo, const double* hi) {
  auto* solver = new Solver{std::size_t(nx), std::size_t(nu), std::size_t(horizon), std::vector<double>(np), {}, {}};
  auto action = std::make_shared<GeneratedAction>(nx, nu, lo, hi, solver->parameters.data());
  std::vector<std::shared_ptr<crocoddyl::ActionModelAbstract>> running(horizon, action);
  solver->problem = std::make_shared<crocoddyl::ShootingProblem>(Eigen::VectorXd::Zero(nx), running, action);
  solver->problem->set_nthreads(1);  // several threads cost milliseconds at this size, and share the scratch memory
  solver->ddp = std::make_unique<crocoddyl::SolverBoxDDP>(solver->problem);
  return solver;
}

void croco_free(void* handle) { delete static_cast<Solver*>(handle); }

// Solve from the feasible trajectory xs (N + 1, nx), us (N, nu), both overwritten with the result.
// info: cost, iterations, seconds in solve().
void croco_solve(void* handle, const double* parameters, double* xs, double* us, int iterations, double stop,
                 double* info) {
  auto& solver = *static_cast<Solver*>(handle);
  std::copy(parameters, parameters + solver.parameters.size(), solver.parameters.begin());
  std::vector<Eigen::VectorXd> states, controls;
  for (std::size_t i = 0; i <= solver.horizon; ++i)
    states.push_back(Eigen::Map<Eigen::VectorXd>(xs + i * solver.nx, solver.nx));
  for (std::size_t i = 0; i < solver.horizon; ++i)
    controls.push_back(Eigen::Map<Eigen::VectorXd>(us + i * solver.nu, solver.nu));
  solver.problem->set_x0(states[0]);
  solver.ddp->set_th_stop(stop);

  const auto start = std::chrono::steady_clock::now();
  const bool converged = solver.ddp->solve(states, controls, iterations, true);
  const auto end = std::chrono::steady_clock::now();

  for (std::size_t i = 0; i <= solver.horizon; ++i)
    Eigen::Map<Eigen::VectorXd>(xs + i * solver.nx, solver.nx) = solver.ddp->get_xs()[i];
  for (std::size_t i = 0; i < solver.horizon; ++i)
    Eigen::Map<Eigen::VectorXd>(us + i * solver.nu, solver.nu) = solver.ddp->get_us()[i];
  info[0] = solver.ddp->get_cost();
  info[1] = double(solver.ddp->get_iter() + (converged ? 1 : 0));
  info[2] = std::chrono::duration<double>(end - start).count();
}
}
