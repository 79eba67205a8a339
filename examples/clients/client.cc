// A minimal client in C++: plays a scenario and writes every reply to a file.
//
//     client ADDRESS SCENARIO FILE
//
// ADDRESS is unix:/path or host:port; SCENARIO is cart_pole, hopper, snapshots or act. client.go beside this file, and
// crates/protocol/examples/client.rs, do the same, and `make languages-test` compares the files.
// docs/tutorials/another-language.md explains the steps.

#include <grpcpp/grpcpp.h>

#include <cstdint>
#include <cstring>
#include <fstream>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "perturb/v1/perturb.grpc.pb.h"

namespace pb = perturb::v1;

// A session: a stream that owns a batch of environments. The destructor ends the stream, and the server then frees the
// environments.
class Session {
 public:
  Session(const std::string& address, const std::string& file) : replies_(file, std::ios::binary) {
    grpc::ChannelArguments arguments;
    // By default gRPC sends a Unix socket's path as the host name, which the server's HTTP/2 library refuses.
    arguments.SetString(GRPC_ARG_DEFAULT_AUTHORITY, "localhost");
    arguments.SetMaxReceiveMessageSize(-1);  // the default of 4 MiB is too small for large batches
    stub_ = pb::Perturb::NewStub(grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(), arguments));
    stream_ = stub_->Session(&context_);
  }

  // Sends a request and waits for its reply, so at most one request is in flight. A client that writes many requests
  // before it reads their replies must write and read in two threads. In one thread it could block for ever, because
  // flow control lets neither side write until the other side reads.
  pb::SessionResponse Call(const pb::SessionRequest& request) {
    pb::SessionResponse response;
    if (!stream_->Write(request) || !stream_->Read(&response)) {
      const grpc::Status status = stream_->Finish();
      throw std::runtime_error("the stream ended with status " + std::to_string(status.error_code()) + ": " +
                               status.error_message());
    }
    response.SerializeToOstream(&replies_);
    return response;
  }

  // Sends a request like `Call`, and throws an exception if the server refuses it.
  pb::SessionResponse Ask(const pb::SessionRequest& request) {
    pb::SessionResponse response = Call(request);
    if (response.has_error()) {
      throw std::runtime_error(std::to_string(response.error().code()) + ": " + response.error().message());
    }
    return response;
  }

  pb::Stepped Step(const std::string& actions) {
    pb::SessionRequest request;
    request.mutable_step()->set_actions(actions);
    return Ask(request).stepped();
  }

  // Ends the session.
  void Close() {
    stream_->WritesDone();
    const grpc::Status status = stream_->Finish();
    if (!status.ok()) throw std::runtime_error("the session ended with: " + status.error_message());
    if (!replies_.flush()) throw std::runtime_error("the replies cannot be written");
  }

 private:
  std::ofstream replies_;
  std::unique_ptr<pb::Perturb::Stub> stub_;
  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<pb::SessionRequest, pb::SessionResponse>> stream_;
};

// Returns the numbers of an array. Arrays on the wire are little-endian, like this processor. The bytes may begin at an
// unaligned address, so they are copied.
template <typename Number>
std::vector<Number> Read(const std::string& bytes) {
  std::vector<Number> numbers(bytes.size() / sizeof(Number));
  std::memcpy(numbers.data(), bytes.data(), numbers.size() * sizeof(Number));
  return numbers;
}

template <typename Number>
std::string Write(const std::vector<Number>& numbers) {
  return std::string(reinterpret_cast<const char*>(numbers.data()), numbers.size() * sizeof(Number));
}

pb::SessionRequest Open(const std::string& environment, pb::Version version, uint32_t batch_size, uint64_t seed) {
  pb::SessionRequest request;
  pb::Open* open = request.mutable_open();
  open->set_environment(environment);
  open->set_version(version);
  open->set_batch_size(batch_size);
  open->set_seed(seed);
  open->set_autoreset_mode(pb::AUTORESET_MODE_SAME_STEP);
  return request;
}

// Returns CartPole's actions, which push each cart under its falling pole. A row of `observations` has the cart's
// position and velocity, and the pole's angle and angular velocity.
std::string Balance(const std::string& observations) {
  const std::vector<float> rows = Read<float>(observations);
  std::vector<int32_t> actions;
  for (size_t row = 0; row < rows.size(); row += 4) actions.push_back(rows[row + 2] + rows[row + 3] > 0.0f ? 1 : 0);
  return Write(actions);
}

// Returns Hopper's actions, which turn its three joints back to position 0. A row of `observations` has 15 numbers, and
// the positions of the joints have the indices 8, 10 and 12.
std::string Straighten(const std::string& observations) {
  const std::vector<float> rows = Read<float>(observations);
  std::vector<float> actions;
  for (size_t row = 0; row < rows.size(); row += 15) {
    for (const size_t joint : {8, 10, 12}) actions.push_back(-0.5f * rows[row + joint]);
  }
  return Write(actions);
}

// Plays 256 CartPoles with parameters of version E for 1000 steps.
void CartPole(Session& session) {
  pb::SessionRequest open = Open("CartPole", pb::VERSION_EXTREME, 256, 1);
  open.mutable_open()->set_receipts(true);
  const std::string first = session.Ask(open).opened().observations();
  // A reset with the seed of `open` for each environment gives the first observations again.
  pb::SessionRequest reset;
  for (int slot = 0; slot < 256; ++slot) reset.mutable_reset()->add_seeds(1);
  std::string observations = session.Ask(reset).reset().observations();
  if (observations != first) throw std::runtime_error("a reset with the seed of open gave other observations");
  for (int step = 0; step < 1000; ++step) observations = session.Step(Balance(observations)).observations();
}

// Plays 16 Hoppers with parameters of version R for 300 steps, and requests the terms of the reward.
void Hopper(Session& session) {
  pb::SessionRequest open = Open("Hopper", pb::VERSION_RANDOM, 16, 2);
  open.mutable_open()->set_autoreset_mode(pb::AUTORESET_MODE_NEXT_STEP);
  open.mutable_open()->set_reward_terms(true);
  std::string observations = session.Ask(open).opened().observations();
  for (int step = 0; step < 300; ++step) observations = session.Step(Straighten(observations)).observations();
}

// Saves 8 CartPoles after 20 steps, plays 50 steps, restores them, and plays 50 steps to the same observations. Then
// sends a step that must be refused.
void Snapshots(Session& session) {
  const pb::Opened opened = session.Ask(Open("CartPole", pb::VERSION_RANDOM, 8, 3)).opened();
  const std::string actions = Write(std::vector<int32_t>{0, 1, 0, 1, 0, 1, 0, 1});
  for (int step = 0; step < 20; ++step) session.Step(actions);
  pb::SessionRequest snapshot;
  snapshot.mutable_snapshot();
  const pb::Snapshotted saved = session.Ask(snapshot).snapshot();
  std::string played[2];
  for (std::string& observations : played) {
    for (int step = 0; step < 50; ++step) observations += session.Step(actions).observations();
    pb::SessionRequest restore;
    *restore.mutable_restore()->mutable_snapshots() = saved.snapshots();
    session.Ask(restore);
  }
  if (played[0] != played[1]) throw std::runtime_error("the restored environments gave other observations");
  // A wrong request is refused and changes nothing.
  pb::SessionRequest wrong;
  wrong.mutable_step()->set_actions("?");
  if (session.Call(wrong).error().code() != grpc::INVALID_ARGUMENT) throw std::runtime_error("not refused");
  session.Step(actions);
}

// Lets the server play 8 CartPoles with a policy: 500 steps, then 20 episodes.
void Act(Session& session) {
  session.Ask(Open("CartPole", pb::VERSION_RANDOM, 8, 4));
  // Weights of the policy network (n = 2) and the value network (n = 1), each [16, 4], [16], [16, 16], [16], [n, 16], [n].
  std::vector<float> weights;
  for (int i = 0; i < 2 * (80 + 272) + (2 + 1) * 17; ++i) weights.push_back(static_cast<float>(i * 37 % 17 - 8) / 16.0f);
  pb::SessionRequest act;
  act.mutable_act()->set_steps(500);
  act.mutable_act()->set_weights(Write(weights));
  act.mutable_act()->mutable_policy()->add_hidden(16);
  act.mutable_act()->mutable_policy()->add_hidden(16);
  act.mutable_act()->mutable_policy()->mutable_training()->set_key(std::string(32, '\0'));
  while (!session.Ask(act).act().finished()) {
    act.Clear();
    act.mutable_act();  // continues the task
  }
  act.Clear();
  act.mutable_act()->set_episodes(20);
  act.mutable_act()->set_only_ended(true);
  while (!session.Ask(act).act().finished()) {
    act.Clear();
    act.mutable_act();
  }
  pb::SessionRequest save;
  save.mutable_save_player();
  session.Ask(save);
}

int main(int count, char** arguments) {
  if (count != 4) {
    std::cerr << "usage: client ADDRESS cart_pole|hopper|snapshots|act FILE\n";
    return 2;
  }
  const std::string scenario = arguments[2];
  try {
    Session session(arguments[1], arguments[3]);
    if (scenario == "cart_pole") {
      CartPole(session);
    } else if (scenario == "hopper") {
      Hopper(session);
    } else if (scenario == "snapshots") {
      Snapshots(session);
    } else if (scenario == "act") {
      Act(session);
    } else {
      throw std::runtime_error("there is no scenario " + scenario);
    }
    session.Close();
  } catch (const std::exception& error) {
    std::cerr << scenario << ": " << error.what() << '\n';
    return 1;
  }
}
