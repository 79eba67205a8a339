// A minimal client in Go: plays a scenario and writes every reply to a file.
//
//	client ADDRESS SCENARIO FILE
//
// ADDRESS is unix:/path or host:port; SCENARIO is cart_pole, hopper, snapshots or act. client.cc beside this file, and
// crates/protocol/examples/client.rs, do the same, and `make languages-test` compares the files.
// docs/tutorials/another-language.md explains the steps.
package main

import (
	"bufio"
	"bytes"
	"context"
	"encoding/binary"
	"errors"
	"fmt"
	"io"
	"math"
	"os"

	"google.golang.org/grpc"
	"google.golang.org/grpc/codes"
	"google.golang.org/protobuf/proto"

	pb "perturb/v1"
)

// session is a stream that owns a batch of environments, with the file to which all replies are written.
type session struct {
	stream  pb.Perturb_SessionClient
	replies *bufio.Writer
}

// call sends a request and waits for its reply, so at most one request is in flight. A client that sends many requests
// before it receives their replies must send and receive in two goroutines. In one goroutine it could block for ever,
// because flow control lets neither side send until the other side receives.
func (s *session) call(request *pb.SessionRequest) (*pb.SessionResponse, error) {
	// If the stream has ended, Send returns io.EOF, and Recv returns the stream's status.
	if err := s.stream.Send(request); err != nil && err != io.EOF {
		return nil, err
	}
	response, err := s.stream.Recv()
	if err != nil {
		return nil, fmt.Errorf("the stream ended: %w", err)
	}
	reply, err := proto.MarshalOptions{Deterministic: true}.Marshal(response)
	if err != nil {
		return nil, err
	}
	_, err = s.replies.Write(reply)
	return response, err
}

// ask sends a request like call, and returns an error if the server refuses it.
func (s *session) ask(request *pb.SessionRequest) (*pb.SessionResponse, error) {
	response, err := s.call(request)
	if err == nil && response.GetError() != nil {
		err = fmt.Errorf("%v: %s", codes.Code(response.GetError().Code), response.GetError().Message)
	}
	return response, err
}

// step returns the observations after a step.
func (s *session) step(actions []byte) ([]byte, error) {
	response, err := s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_Step{Step: &pb.Step{Actions: actions}}})
	return response.GetStepped().GetObservations(), err
}

func (s *session) open(open *pb.Open) (*pb.Opened, error) {
	response, err := s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_Open{Open: open}})
	return response.GetOpened(), err
}

func floats(array []byte) []float32 {
	numbers := make([]float32, len(array)/4)
	for i := range numbers {
		numbers[i] = math.Float32frombits(binary.LittleEndian.Uint32(array[4*i:]))
	}
	return numbers
}

func array(numbers interface{}) []byte {
	var buffer bytes.Buffer
	binary.Write(&buffer, binary.LittleEndian, numbers) // does not fail, because a buffer grows as needed
	return buffer.Bytes()
}

// balance returns CartPole's actions, which push each cart under its falling pole. A row of observations has the cart's
// position and velocity, and the pole's angle and angular velocity.
func balance(observations []byte) []byte {
	rows := floats(observations)
	var actions []int32
	for row := 0; row < len(rows); row += 4 {
		action := int32(0)
		if rows[row+2]+rows[row+3] > 0 {
			action = 1
		}
		actions = append(actions, action)
	}
	return array(actions)
}

// straighten returns Hopper's actions, which turn its three joints back to position 0. A row of observations has 15
// numbers, and the positions of the joints have the indices 8, 10 and 12.
func straighten(observations []byte) []byte {
	rows := floats(observations)
	var actions []float32
	for row := 0; row < len(rows); row += 15 {
		for _, joint := range []int{8, 10, 12} {
			actions = append(actions, -0.5*rows[row+joint])
		}
	}
	return array(actions)
}

// cartPole plays 256 CartPoles with parameters of version E for 1000 steps.
func cartPole(s *session) error {
	opened, err := s.open(&pb.Open{
		Environment: "CartPole", Version: pb.Version_VERSION_EXTREME, BatchSize: 256, Seed: 1,
		AutoresetMode: pb.AutoresetMode_AUTORESET_MODE_SAME_STEP, Receipts: true,
	})
	if err != nil {
		return err
	}
	// A reset with the seed of `open` for each environment gives the first observations again.
	seeds := make([]uint64, 256)
	for slot := range seeds {
		seeds[slot] = 1
	}
	response, err := s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_Reset_{Reset_: &pb.Reset{Seeds: seeds}}})
	if err != nil {
		return err
	}
	observations := response.GetReset_().GetObservations()
	if !bytes.Equal(observations, opened.Observations) {
		return errors.New("a reset with the seed of open gave other observations")
	}
	for step := 0; step < 1000 && err == nil; step++ {
		observations, err = s.step(balance(observations))
	}
	return err
}

// hopper plays 16 Hoppers with parameters of version R for 300 steps, and requests the terms of the reward.
func hopper(s *session) error {
	opened, err := s.open(&pb.Open{
		Environment: "Hopper", Version: pb.Version_VERSION_RANDOM, BatchSize: 16, Seed: 2,
		AutoresetMode: pb.AutoresetMode_AUTORESET_MODE_NEXT_STEP, RewardTerms: true,
	})
	observations := opened.GetObservations()
	for step := 0; step < 300 && err == nil; step++ {
		observations, err = s.step(straighten(observations))
	}
	return err
}

// snapshots saves 8 CartPoles after 20 steps, plays 50 steps, restores them, and plays 50 steps to the same
// observations. Then it sends a step that must be refused.
func snapshots(s *session) error {
	if _, err := s.open(&pb.Open{
		Environment: "CartPole", Version: pb.Version_VERSION_RANDOM, BatchSize: 8, Seed: 3,
		AutoresetMode: pb.AutoresetMode_AUTORESET_MODE_SAME_STEP,
	}); err != nil {
		return err
	}
	actions := array([]int32{0, 1, 0, 1, 0, 1, 0, 1})
	play := func(steps int) (played []byte, err error) {
		for step := 0; step < steps; step++ {
			observations, err := s.step(actions)
			if err != nil {
				return nil, err
			}
			played = append(played, observations...)
		}
		return played, nil
	}
	if _, err := play(20); err != nil {
		return err
	}
	response, err := s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_Snapshot{Snapshot: &pb.Snapshot{}}})
	if err != nil {
		return err
	}
	restore := &pb.Restore{Snapshots: response.GetSnapshot().GetSnapshots()}
	var played [2][]byte
	for i := range played {
		if played[i], err = play(50); err != nil {
			return err
		}
		if _, err = s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_Restore{Restore: restore}}); err != nil {
			return err
		}
	}
	if !bytes.Equal(played[0], played[1]) {
		return errors.New("the restored environments gave other observations")
	}
	// A wrong request is refused and changes nothing.
	wrong := &pb.Step{Actions: []byte("?")}
	response, err = s.call(&pb.SessionRequest{Request: &pb.SessionRequest_Step{Step: wrong}})
	if err != nil {
		return err
	}
	if codes.Code(response.GetError().GetCode()) != codes.InvalidArgument {
		return errors.New("not refused")
	}
	_, err = s.step(actions)
	return err
}

// act lets the server play 8 CartPoles with a policy: 500 steps, then 20 episodes.
func act(s *session) error {
	if _, err := s.open(&pb.Open{
		Environment: "CartPole", Version: pb.Version_VERSION_RANDOM, BatchSize: 8, Seed: 4,
		AutoresetMode: pb.AutoresetMode_AUTORESET_MODE_SAME_STEP,
	}); err != nil {
		return err
	}
	play := func(request *pb.Act) error {
		for {
			response, err := s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_Act{Act: request}})
			if err != nil || response.GetAct().GetFinished() {
				return err
			}
			request = &pb.Act{} // continues the task
		}
	}
	// Weights of the policy network (n = 2) and the value network (n = 1), each [16, 4], [16], [16, 16], [16], [n, 16], [n].
	var weights []float32
	for i := 0; i < 2*(80+272)+(2+1)*17; i++ {
		weights = append(weights, float32(i*37%17-8)/16)
	}
	policy := &pb.Policy{
		Hidden: []uint32{16, 16},
		Role:   &pb.Policy_Training{Training: &pb.RandomStream{Key: make([]byte, 32)}},
	}
	if err := play(&pb.Act{Policy: policy, Weights: array(weights), Task: &pb.Act_Steps{Steps: 500}}); err != nil {
		return err
	}
	if err := play(&pb.Act{Task: &pb.Act_Episodes{Episodes: 20}, OnlyEnded: true}); err != nil {
		return err
	}
	_, err := s.ask(&pb.SessionRequest{Request: &pb.SessionRequest_SavePlayer{SavePlayer: &pb.SavePlayer{}}})
	return err
}

func run(address, scenario, file string) (err error) {
	scenarios := map[string]func(*session) error{"cart_pole": cartPole, "hopper": hopper, "snapshots": snapshots, "act": act}
	play, known := scenarios[scenario]
	if !known {
		return errors.New("there is no such scenario")
	}
	replies, err := os.Create(file)
	if err != nil {
		return err
	}
	defer replies.Close()
	connection, err := grpc.Dial(
		address,
		grpc.WithInsecure(),
		// By default gRPC may send a Unix socket's path as the host name, which the server's HTTP/2 library refuses.
		grpc.WithAuthority("localhost"),
		// The default of 4 MiB is too small for large batches.
		grpc.WithDefaultCallOptions(grpc.MaxCallRecvMsgSize(math.MaxInt32)),
	)
	if err != nil {
		return err
	}
	defer connection.Close()
	stream, err := pb.NewPerturbClient(connection).Session(context.Background())
	if err != nil {
		return err
	}
	s := &session{stream: stream, replies: bufio.NewWriter(replies)}
	if err := play(s); err != nil {
		return err
	}
	// Ends the session. The server ends the stream with status OK, which is EOF here.
	if err := stream.CloseSend(); err != nil {
		return err
	}
	if _, err := stream.Recv(); err != io.EOF {
		return fmt.Errorf("the session ended with: %v", err)
	}
	return s.replies.Flush()
}

func main() {
	if len(os.Args) != 4 {
		fmt.Fprintln(os.Stderr, "usage: client ADDRESS cart_pole|hopper|snapshots|act FILE")
		os.Exit(2)
	}
	if err := run(os.Args[1], os.Args[2], os.Args[3]); err != nil {
		fmt.Fprintf(os.Stderr, "%s: %v\n", os.Args[2], err)
		os.Exit(1)
	}
}
